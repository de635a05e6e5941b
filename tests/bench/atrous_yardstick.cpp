// The a-trous stage of svgf_jax by hand: GCC vector extensions, OpenMP over rows, sums in registers. A yardstick, not a product:
// what a careful programmer gets out of the same machine for the same arithmetic. See speed.py.
#include <cstdint>
#include <cstring>
#include <vector>

#ifdef __AVX512F__
constexpr int WIDTH = 16;
#else // a vector wider than the registers would be taken apart, and through memory
constexpr int WIDTH = 8;
#endif
using Lanes = float __attribute__((vector_size(4 * WIDTH)));
using Ints = int32_t __attribute__((vector_size(4 * WIDTH)));

static inline Lanes load(const float *p) { Lanes v; std::memcpy(&v, p, sizeof v); return v; }
static inline void store(float *p, Lanes v) { std::memcpy(p, &v, sizeof v); }
static inline Lanes bits(Ints i) { return (Lanes)i; }
static inline Lanes magnitude(Lanes v) { return bits((Ints)v & 0x7fffffff); }
static inline Lanes larger(Lanes a, Lanes b) { return a > b ? a : b; }

static inline Lanes exp_of(Lanes x) { // x <= 0
    const Lanes t = larger(x, Lanes{} - 87.0f) * 1.44269504f;
    const Ints n = __builtin_convertvector(t, Ints);
    const Lanes f = (t - __builtin_convertvector(n, Lanes)) * 0.693147181f; // in (-ln 2, 0]
    Lanes p = Lanes{} + 1.0f / 5040;
    p = p * f + 1.0f / 720; p = p * f + 1.0f / 120; p = p * f + 1.0f / 24;
    p = p * f + 1.0f / 6; p = p * f + 0.5f; p = p * f + 1.0f; p = p * f + 1.0f;
    return p * bits((n + 127) << 23);
}

static inline Lanes log_of(Lanes x) { // x > 0; polynomial of Cephes' logf
    Ints e = ((Ints)x >> 23) - 126;
    Lanes m = bits(((Ints)x & 0x007fffff) | 0x3f000000); // in [1/2, 1)
    const Ints low = m < 0.707106781f;
    m = low ? m + m : m;
    e = low ? e - 1 : e;
    const Lanes f = m - 1.0f, z = f * f;
    Lanes p = Lanes{} + 7.0376836292e-2f;
    p = p * f - 1.1514610310e-1f; p = p * f + 1.1676998740e-1f; p = p * f - 1.2420140846e-1f;
    p = p * f + 1.4249322787e-1f; p = p * f - 1.6668057665e-1f; p = p * f + 2.0000714765e-1f;
    p = p * f - 2.4999993993e-1f; p = p * f + 3.3333331174e-1f;
    return f + f * z * p - 0.5f * z + __builtin_convertvector(e, Lanes) * 0.693147181f;
}

struct Image { // a plane with a border of zeros
    int border, stride;
    std::vector<float> data;
    Image(int h, int w, int b) : border(b), stride(w + 2 * b + WIDTH), data((size_t)stride * (h + 2 * b)) {}
    float *row(int y) { return data.data() + (size_t)(y + border) * stride + border; }
};

template <int S>
static void filter(int h, int w, int levels, int feedback, const float *sigma, float *colors, float *variances,
                   const float *depth, const float *normal, const int32_t *ids, const float *slope_x, const float *slope_y,
                   float *fed_back) {
    const float sigma_luminance = sigma[0], sigma_normal = sigma[1], sigma_depth = sigma[2], depth_epsilon = sigma[3],
                luminance_epsilon = sigma[4], kernel[5] = {sigma[6], sigma[5], 1.0f, sigma[5], sigma[6]};
    const int border = 2 << (levels - 1);
    Image z(h, w, border), surface(h, w, border), n[3] = {{h, w, border}, {h, w, border}, {h, w, border}};
    std::vector<Image> now, next, scale, light; // per signal: three colours and a variance
    for (int i = 0; i < 4 * S; i++) { now.emplace_back(h, w, border); next.emplace_back(h, w, border); }
    for (int s = 0; s < S; s++) { light.emplace_back(h, w, border); scale.emplace_back(h, w, border); }
    const size_t plane = (size_t)h * w;
#pragma omp parallel for schedule(static)
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
            const size_t i = (size_t)y * w + x;
            z.row(y)[x] = depth[i];
            surface.row(y)[x] = ids[i] != -1;
            for (int c = 0; c < 3; c++) n[c].row(y)[x] = normal[3 * i + c];
            for (int s = 0; s < S; s++) {
                for (int c = 0; c < 3; c++) now[4 * s + c].row(y)[x] = colors[3 * (s * plane + i) + c];
                now[4 * s + 3].row(y)[x] = variances[s * plane + i];
            }
        }
    for (int level = 0; level < levels; level++) {
        const int step = 1 << level;
#pragma omp parallel for schedule(dynamic, 8)
        for (int y = 0; y < h; y++)
            for (int s = 0; s < S; s++) {
                float *l = light[s].row(y), *k = scale[s].row(y);
                const float *r = now[4 * s].row(y), *g = now[4 * s + 1].row(y), *b = now[4 * s + 2].row(y);
                for (int x = 0; x < w; x++) l[x] = 0.2126f * r[x] + 0.7152f * g[x] + 0.0722f * b[x];
                for (int x = 0; x < w; x++) {
                    float total = 0, weights = 0;
                    for (int dy = -1; dy <= 1; dy++)
                        for (int dx = -1; dx <= 1; dx++) {
                            const float weight = (dy ? 0.25f : 0.5f) * (dx ? 0.25f : 0.5f) * surface.row(y + dy)[x + dx];
                            total += weight * now[4 * s + 3].row(y + dy)[x + dx];
                            weights += weight;
                        }
                    const float v = weights > 0 ? total / weights : 0.0f;
                    k[x] = 1.0f / __builtin_fmaxf(sigma_luminance * __builtin_sqrtf(v) + luminance_epsilon, 1e-15f);
                }
            }
#pragma omp parallel for schedule(dynamic, 8)
        for (int y = 0; y < h; y++)
            for (int x = 0; x < w; x += WIDTH) {
                const Lanes zp = load(z.row(y) + x), zero{};
                const Lanes np[3] = {load(n[0].row(y) + x), load(n[1].row(y) + x), load(n[2].row(y) + x)};
                float slopes[2][WIDTH] = {};
                const int inside = w - x < WIDTH ? w - x : WIDTH;
                std::memcpy(slopes[0], slope_x + (size_t)y * w + x, inside * sizeof(float));
                std::memcpy(slopes[1], slope_y + (size_t)y * w + x, inside * sizeof(float));
                const Lanes gx = load(slopes[0]), gy = load(slopes[1]);
                Lanes lp[S], kp[S], sums[S][4] = {}, weights[S] = {};
                for (int s = 0; s < S; s++) { lp[s] = load(light[s].row(y) + x); kp[s] = load(scale[s].row(y) + x); }
                for (int ty = -2; ty <= 2; ty++)
                    for (int tx = -2; tx <= 2; tx++) {
                        const int qy = y + ty * step, qx = x + tx * step;
                        const Lanes change = magnitude(gx * (float)(tx * step) + gy * (float)(ty * step));
                        const Lanes tolerance = sigma_depth * change + depth_epsilon * zp;
                        const Lanes difference = magnitude(load(z.row(qy) + qx) - zp);
                        const Lanes by_depth = tolerance > 1e-12f ? -difference / tolerance : (difference == 0 ? zero : zero - 1e4f);
                        const Lanes cosine = np[0] * load(n[0].row(qy) + qx) + np[1] * load(n[1].row(qy) + qx) +
                                             np[2] * load(n[2].row(qy) + qx);
                        const Lanes by_normal = cosine > 1e-30f ? sigma_normal * log_of(cosine) : zero - 1e4f;
                        const Lanes kernel_weight = kernel[ty + 2] * kernel[tx + 2] * load(surface.row(qy) + qx);
                        for (int s = 0; s < S; s++) {
                            const Lanes by_light = magnitude(load(light[s].row(qy) + qx) - lp[s]) * kp[s];
                            const Lanes weight = kernel_weight * exp_of(by_depth + by_normal - by_light);
                            weights[s] += weight;
                            for (int c = 0; c < 3; c++) sums[s][c] += weight * load(now[4 * s + c].row(qy) + qx);
                            sums[s][3] += weight * weight * load(now[4 * s + 3].row(qy) + qx);
                        }
                    }
                for (int s = 0; s < S; s++) {
                    const Ints any = weights[s] > 1e-15f;
                    const Lanes inverse = 1.0f / (any ? weights[s] : zero + 1.0f);
                    for (int c = 0; c < 4; c++) {
                        const Lanes mean = sums[s][c] * (c == 3 ? inverse * inverse : inverse);
                        float result[WIDTH];
                        store(result, any ? mean : load(now[4 * s + c].row(y) + x));
                        std::memcpy(next[4 * s + c].row(y) + x, result, inside * sizeof(float));
                    }
                }
            }
        std::swap(now, next);
        const bool last = level == levels - 1;
        if (level == feedback || last)
#pragma omp parallel for schedule(static)
            for (int y = 0; y < h; y++)
                for (int s = 0; s < S; s++)
                    for (int x = 0; x < w; x++) {
                        const size_t i = s * plane + (size_t)y * w + x;
                        for (int c = 0; c < 3; c++) {
                            const float value = now[4 * s + c].row(y)[x];
                            if (level == feedback) fed_back[3 * i + c] = value;
                            if (last) colors[3 * i + c] = value;
                        }
                        if (last) variances[i] = now[4 * s + 3].row(y)[x];
                    }
    }
}

// Images as in svgf_jax.atrous_filter, C order; `colors` and `variances` are replaced. sigma: sigma_luminance, sigma_normal,
// sigma_depth, depth_epsilon, luminance_epsilon, kernel_near, kernel_far.
extern "C" void atrous(int signals, int h, int w, int levels, int feedback, const float *sigma, float *colors, float *variances,
                       const float *depth, const float *normal, const int32_t *ids, const float *slope_x, const float *slope_y,
                       float *fed_back) {
    (signals == 1 ? filter<1> : filter<2>)(h, w, levels, feedback, sigma, colors, variances, depth, normal, ids, slope_x, slope_y,
                                           fed_back);
}

// As many multiply-adds as the machine can do: sixteen independent sums a core, all in registers. Returns how many were done.
extern "C" double multiply_adds(long turns) {
    double done = 0, kept = 0;
#pragma omp parallel reduction(+ : done, kept)
    {
        Lanes sums[16] = {};
        Lanes factor = Lanes{} + 0.999f;
        for (long i = 0; i < turns; i++) {
            asm volatile("" : "+v"(factor)); // not to be worked out beforehand
            for (Lanes &sum : sums) sum = sum * factor + factor;
        }
        for (Lanes &sum : sums) kept += sum[0];
        done = 16.0 * WIDTH * turns;
    }
    return kept < 0 ? kept : done;
}
