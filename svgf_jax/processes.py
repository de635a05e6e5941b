"""Several processes that know of one another: by JAX's own runtime, which finds its way under Slurm, Kubernetes and MPI.

They meet, agree on small things as bytes, and leave. All arithmetic stays within each process: JAX is told to forget the others
once they have met, so that a process that dies takes none with it. Imports JAX when first used, not before.
"""

import contextlib
import os
import time
from typing import Any, NamedTuple

from svgf_jax.types import SvgfError

MEET_WITHIN = 300  # seconds
DEAD_AFTER = 30  # seconds without a sign of life
_ASK_EVERY = 2000  # milliseconds
_PATIENCE = 10  # seconds that process 0 waits for the others to leave
_KEPT = ("client", "service", "process_id", "num_processes", "coordinator_address")
_ASKED = ("key_value_set_bytes", "blocking_key_value_get_bytes", "get_live_nodes", "shutdown")


class Process(NamedTuple):
    """One of several.

    Attributes:
        rank, size: which it is, from 0 on, and of how many.
        client, service: the runtime's; None where there is but one.
    """

    rank: int = 0
    size: int = 1
    client: Any = None
    service: Any = None


def check_meeting(distributed: bool, coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Raise SvgfError where these options can't be meant, before JAX is asked."""
    given = [value is not None for value in (coordinator, processes, process)]
    if any(given) and not distributed:
        raise SvgfError("Got --coordinator, --processes or --process without --distributed; add it, or leave them out.")
    if any(given) and not all(given):
        raise SvgfError(
            f"Got --coordinator {coordinator}, --processes {processes}, --process {process}; wanted all three, for example "
            "--coordinator node1:8476 --processes 3 --process 0, or none under Slurm, Kubernetes or MPI."
        )
    if processes is not None and process is not None and not 0 <= process < processes:
        raise SvgfError(f"Got --process {process} of --processes {processes}; wanted 0 to {processes - 1}.")
    if coordinator is not None and not coordinator.rpartition(":")[2].isdigit():
        raise SvgfError(f"Got --coordinator {coordinator}; wanted HOST:PORT of process 0, for example node1:8476.")


def meet(
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    *,
    within: int = MEET_WITHIN,
    dead_after: int = DEAD_AFTER,
) -> Process:
    """Wait until all processes are there: which one this is. Before any other use of JAX.

    Raises SvgfError: nothing tells which process this is, or not all came `within` so many seconds.
    """
    check_meeting(True, coordinator, processes, process)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # else the runtime warns of what is meant here
    import jax

    state = _state()
    try:
        # Otherwise one that dies ends all others, without a word of what to do.
        jax.config.update("jax_enable_recoverability", True)
        jax.distributed.initialize(
            coordinator,
            processes,
            process,
            cluster_detection_method=None if coordinator is None else "deactivate",
            initialization_timeout=within,
            heartbeat_timeout_seconds=dead_after,
        )
    except (AttributeError, TypeError) as error:
        raise _other_jax(str(error)) from error
    except ValueError as error:
        raise SvgfError(
            f"Nothing here tells which of several processes this is ({error}). Start it under Slurm, Kubernetes or MPI, or say: "
            "--coordinator HOST:PORT --processes N --process I."
        ) from error
    except RuntimeError as error:
        raise SvgfError(
            f"The processes did not all meet at {state.coordinator_address} within {within} s ({str(error).splitlines()[0]}). "
            "Start all of them, with one address of process 0 that the others can reach."
        ) from error
    _require(state.client, _ASKED)
    me = Process(state.process_id, int(state.num_processes or 1), state.client, state.service)
    # From here on JAX knows this process alone.
    state.client = state.service = None
    state.process_id, state.num_processes = 0, 1
    return me


def _state() -> Any:
    """Where JAX keeps the client of its runtime. Nothing public gives that, or which process this is without making a backend.

    Raises SvgfError: this JAX keeps it elsewhere.
    """
    try:
        from jax._src.distributed import global_state
    except ImportError as error:
        raise _other_jax(str(error)) from error
    _require(global_state, _KEPT)
    return global_state


def _require(thing: object, names: tuple[str, ...]) -> None:
    if missing := [name for name in names if not hasattr(thing, name)]:
        raise _other_jax(f"{type(thing).__name__} has no {', '.join(missing)}")


def _other_jax(why: str) -> SvgfError:
    from jax import __version__

    return SvgfError(
        f"Several processes cannot meet by JAX {__version__}, which is made in another way than wanted ({why}). They can by JAX "
        "0.10 to 0.12; or leave out --distributed, and give each process its own frames (--frames)."
    )


def gather(me: Process, name: str, mine: bytes) -> list[bytes]:
    """What each process gave under this name, in their order; it is given once. Waits for all.

    Raises SvgfError: a process is gone.
    """
    if me.client is None:
        return [mine]
    me.client.key_value_set_bytes(f"svgf/{name}/{me.rank}", mine)
    return [mine if i == me.rank else _of(me, i, f"svgf/{name}/{i}") for i in range(me.size)]


def _of(me: Process, other: int, key: str) -> bytes:
    while True:
        try:
            return me.client.blocking_key_value_get_bytes(key, _ASK_EVERY)
        except RuntimeError as error:
            if "DEADLINE_EXCEEDED" not in str(error):
                raise _gone(me, 0) from error
        try:
            alive = me.client.get_live_nodes(list(range(me.size)))
        except RuntimeError as error:
            raise _gone(me, 0) from error
        if other not in alive:
            raise _gone(me, other)


def _gone(me: Process, other: int) -> SvgfError:
    return SvgfError(
        f"Process {other} of {me.size} (counted from 0) has ended before its work was done, so process {me.rank} ends too. What "
        f"process {other} said last tells why. Start all of them again, with --resume."
    )


def leave(me: Process) -> None:
    """Part from the others, whether they are there or not; process 0, which holds what they gave, is the last to go."""
    if me.service is not None:
        until = time.monotonic() + _PATIENCE
        with contextlib.suppress(RuntimeError):
            while len(me.client.get_live_nodes(list(range(me.size)))) > 1 and time.monotonic() < until:
                time.sleep(0.05)
    for one in (me.client, me.service):
        if one is not None:
            with contextlib.suppress(RuntimeError):  # process 0, which holds it all, is gone
                one.shutdown()
