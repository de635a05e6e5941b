"use strict";
// The viewer of a report: which frame, which two pictures, where the line between them is. All pictures are in the page.
(() => {
  const holder = document.getElementById("frames");
  if (!holder) return;
  const {frames, legends} = JSON.parse(holder.textContent);
  const at = (id) => document.getElementById(id);
  const [stage, wipe, scrub, left, right, play] = ["stage", "wipe", "scrub", "left", "right", "play"].map(at);
  const [under, over] = stage.querySelectorAll("img");
  const show = (image, source, text) => {
    image.hidden = !source;
    image.alt = text;
    if (source) image.src = source; else image.removeAttribute("src");
  };

  function drawLine() {
    over.style.clipPath = `inset(0 ${100 - wipe.value}% 0 0)`;
    stage.querySelector(".line").style.left = `${wipe.value}%`;
    wipe.setAttribute("aria-valuetext", `${wipe.value} % ${left.value}, the rest ${right.value}`);
  }

  function drawPicture(image, label, frame, name) {
    const source = frame.pictures[name];
    show(image, source, `frame ${frame.number}, ${name}`);
    label.textContent = source ? [name, frame.notes[name]].filter(Boolean).join(": ") : `${name}: not known for this frame`;
  }

  function drawMaps(frame) {
    const of = frame.maps[right.value] ? right.value : left.value;
    const maps = frame.maps[of] || {};
    const names = Object.keys(maps);
    at("maps-of").textContent = names.length ? `Maps of ${of}, frame ${frame.number}` : `No maps are known of ${of}, frame ${frame.number}`;
    at("maps").replaceChildren(...names.map((name) => {
      const figure = document.createElement("figure");
      const image = document.createElement("img");
      const caption = document.createElement("figcaption");
      const [palette, least, most] = legends[name];
      const scale = document.createElement("span");
      scale.className = "scale";
      scale.style.background = palette;
      image.onload = () => image.classList.toggle("fine", image.naturalWidth < 320);
      show(image, maps[name], `frame ${frame.number}, ${of}: ${name}`);
      caption.append(`${name} `, least, scale, most);
      figure.append(image, caption);
      return figure;
    }));
  }

  function drawPlots(number) {
    for (const plot of document.querySelectorAll("svg[data-x0]")) {
      const {x0, x1, from, to} = plot.dataset;
      const x = Number(from) + (number - x0) / (x1 - x0) * (to - from);
      const now = plot.querySelector(".now");
      now.setAttribute("x1", x);
      now.setAttribute("x2", x);
    }
    for (const line of document.querySelectorAll(".follow g[data-name]")) {
      line.setAttribute("class", line.dataset.name === right.value ? "right k1" : line.dataset.name === left.value ? "left k2" : "");
    }
  }

  function draw() {
    const frame = frames[scrub.value];
    drawPicture(under, stage.querySelector(".is-right"), frame, right.value);
    drawPicture(over, stage.querySelector(".is-left"), frame, left.value);
    at("number").textContent = `frame ${frame.number}`;
    scrub.setAttribute("aria-valuetext", `frame ${frame.number}`);
    drawLine();
    drawMaps(frame);
    drawPlots(frame.number);
  }

  function step(by) {
    scrub.value = (Number(scrub.value) + by + frames.length) % frames.length;
    draw();
  }

  let timer = null;
  const pause = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "play";
  };
  play.onclick = () => {
    if (timer) return pause();
    timer = setInterval(() => step(1), 125);
    play.textContent = "pause";
  };
  at("back").onclick = () => step(-1);
  at("next").onclick = () => step(1);
  scrub.oninput = left.onchange = right.onchange = draw;
  wipe.oninput = drawLine;

  const drag = (event) => {
    const box = stage.getBoundingClientRect();
    wipe.value = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1) * 100;
    drawLine();
  };
  stage.onpointerdown = (event) => {
    event.preventDefault();
    if (event.pointerId !== undefined && event.isTrusted) stage.setPointerCapture(event.pointerId);
    wipe.focus();
    drag(event);
    stage.onpointermove = drag;
  };
  stage.onpointerup = stage.onpointercancel = () => { stage.onpointermove = null; };
  document.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === ",") step(-1);
    else if (event.key === ".") step(1);
  });

  // Small pictures are shown enlarged by a whole factor, pixel by pixel; large ones never wider than the page.
  under.onload = () => {
    const wide = under.naturalWidth;
    const factor = Math.max(1, Math.floor(700 / wide));
    stage.parentNode.style.maxWidth = `${wide * factor}px`;
    for (const image of [under, over]) image.classList.toggle("fine", factor > 1);
  };
  draw();
})();
