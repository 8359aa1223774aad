/* The population's cost by hand: the same methods as ehsvjax in single precision, LANES individuals side by side in
   registers and first-level cache, blocks of individuals spread over the cores. Compiled by against_c.py. */

#include <math.h>

#ifndef LANES
#define LANES 32
#endif

#ifdef __AVX512F__
#define VECTOR 16
#else
#define VECTOR 8
#endif
typedef float vector __attribute__((vector_size(4 * VECTOR)));

/* What the cores can do at best: twelve independent chains of multiply-adds in registers. Returns the number of
   floating-point operations. */
double multiply_adds(long rounds, float *sink) {
  double operations = 0;
#pragma omp parallel reduction(+ : operations)
  {
    vector chain[12], factor, term;
    for (int j = 0; j < VECTOR; j++) factor[j] = 0.999f, term[j] = 1e-3f;
    for (int k = 0; k < 12; k++) chain[k] = term * (float)k;
    for (long i = 0; i < rounds; i++)
      for (int k = 0; k < 12; k++) chain[k] = chain[k] * factor + term;
    for (int k = 1; k < 12; k++) chain[0] += chain[k];
    sink[0] = chain[0][0];
    operations += 2.0 * 12 * VECTOR * rounds;
  }
  return operations;
}

/* Van der Pol oscillator, Runge-Kutta 4. parameters: [4][count] alpha, gamma, x1(0), x2(0). */
void van_der_pol(int count, int samples, int substeps, float period, float scale, const float *restrict parameters,
                 const float *restrict command, const float *restrict measured, float *restrict cost) {
  const float h = period / substeps, half = 0.5f * h, sixth = h / 6.0f;
#pragma omp parallel for schedule(static)
  for (int block = 0; block < count; block += LANES) {
    float alpha[LANES], gamma[LANES], x1[LANES], x2[LANES], sum[LANES];
    for (int i = 0; i < LANES; i++) {
      const int k = block + i < count ? block + i : count - 1;
      alpha[i] = parameters[k], gamma[i] = parameters[count + k];
      x1[i] = parameters[2 * count + k], x2[i] = parameters[3 * count + k], sum[i] = 0.0f;
    }
    for (int t = 0; t < samples; t++) {
      const float u = command[t], y = measured[t];
#pragma omp simd
      for (int i = 0; i < LANES; i++) {
        const float residual = scale * (y - x1[i]);
        sum[i] += residual * residual;
      }
      for (int s = 0; s < substeps; s++) {
#pragma omp simd
        for (int i = 0; i < LANES; i++) {
          const float a = alpha[i], g = gamma[i], p = x1[i], q = x2[i];
          const float k1p = a * q, k1q = u - p + g * (1.0f - p * p) * q;
          const float p2 = p + half * k1p, q2 = q + half * k1q;
          const float k2p = a * q2, k2q = u - p2 + g * (1.0f - p2 * p2) * q2;
          const float p3 = p + half * k2p, q3 = q + half * k2q;
          const float k3p = a * q3, k3q = u - p3 + g * (1.0f - p3 * p3) * q3;
          const float p4 = p + h * k3p, q4 = q + h * k3q;
          const float k4p = a * q4, k4q = u - p4 + g * (1.0f - p4 * p4) * q4;
          x1[i] = p + sixth * (k1p + 2.0f * (k2p + k3p) + k4p);
          x2[i] = q + sixth * (k1q + 2.0f * (k2q + k3q) + k4q);
        }
      }
    }
    for (int i = 0; i < LANES && block + i < count; i++) cost[block + i] = sum[i];
  }
}

/* Exact transition of the second-order transfer function over a time, as in ehsvjax.integrators. */
typedef struct {
  float yy, yr, ry, rr;
} Filter;

static Filter second_order_filter(float damping_ratio, float natural_frequency, float duration) {
  const double w = natural_frequency, h = duration, s = damping_ratio * w * h;
  const double d = ((double)damping_ratio * damping_ratio - 1.0) * w * w * h * h, root = sqrt(fabs(d));
  const double c = d < 0 ? cos(root) : cosh(root), f = root == 0 ? 1 : d < 0 ? sin(root) / root : sinh(root) / root;
  const double decay = exp(-s);
  return (Filter){(float)(decay * (c + s * f) - 1), (float)(decay * f * h), (float)(-decay * f * w * w * h),
                  (float)(decay * (c - s * f) - 1)};
}

static inline float clip(float x, float bound) { return fminf(fmaxf(x, -bound), bound); }

/* Servovalve with the transfer function on the spool: SDIRK2 for the load, the filter exactly.
   parameters: [9][count] dead zone, saturation, flow gain, feedback gain, damping ratio, natural frequency, x(0), p(0),
   p'(0); constants: area, supply pressure, mass, stiffness, capacitance, leakage. */
void servovalve(int count, int samples, int substeps, float period, float scale, const float *restrict parameters,
                const float *restrict constants, const float *restrict command, const float *restrict measured,
                float *restrict cost) {
  const float stage = (float)(1.0 - 0.5 * sqrt(2.0)), carried = (1.0f - stage) / stage;
  const float area = constants[0], supply = constants[1], mass = constants[2], stiffness = constants[3];
  const float h = period / substeps, hs = stage * h, inertia = mass + hs * hs * stiffness;
  const float storage = constants[4] / hs, leakage = constants[5];
  const float by_momentum = area / inertia, per_area = 1.0f / area, per_stage = 1.0f / hs;
  const float by_flow = 1.0f / (hs * area * by_momentum + leakage + storage);
#pragma omp parallel for schedule(static)
  for (int block = 0; block < count; block += LANES) {
    float dead[LANES], limit[LANES], gain[LANES], feedback[LANES], lag[LANES], sum[LANES];
    float yy1[LANES], yr1[LANES], yy[LANES], yr[LANES], ry[LANES], rr[LANES];
    float x[LANES], v[LANES], p[LANES], r[LANES], pressure[LANES];
    for (int i = 0; i < LANES; i++) {
      const int k = block + i < count ? block + i : count - 1;
      const float *all = parameters + k;
      dead[i] = all[0], limit[i] = all[count], gain[i] = all[2 * count], feedback[i] = all[3 * count];
      const Filter first = second_order_filter(all[4 * count], all[5 * count], hs);
      const Filter whole = second_order_filter(all[4 * count], all[5 * count], h);
      yy1[i] = first.yy, yr1[i] = first.yr, yy[i] = whole.yy, yr[i] = whole.yr, ry[i] = whole.ry, rr[i] = whole.rr;
      lag[i] = 2.0f * all[4 * count] / all[5 * count];
      x[i] = all[6 * count], p[i] = all[7 * count], r[i] = all[8 * count], sum[i] = 0.0f;
      pressure[i] = stiffness * x[i] / area;
      const float opening = clip(p[i] - clip(p[i], dead[i]), limit[i]);
      const float drop = supply - copysignf(1.0f, opening) * pressure[i];
      v[i] = gain[i] * opening * copysignf(sqrtf(fabsf(drop)), drop) / area;
    }
    for (int t = 0; t < samples; t++) {
      const float u = command[t], y = measured[t];
#pragma omp simd
      for (int i = 0; i < LANES; i++) {
        const float residual = scale * (y - x[i]);
        sum[i] += residual * residual;
      }
      for (int s = 0; s < substeps; s++) {
#pragma omp simd
        for (int i = 0; i < LANES; i++) {
          const float e = u - feedback[i] * x[i];
          float slope = (u - feedback[i] * (x[i] + hs * v[i]) - e) * per_stage;
          float deviation = p[i] - e + lag[i] * slope, rate_deviation = r[i] - slope;
          float spool = p[i] + slope * hs + yy1[i] * deviation + yr1[i] * rate_deviation;

          float opening = clip(spool - clip(spool, dead[i]), limit[i]);
          float at_rest = by_momentum * (mass * v[i] - hs * stiffness * x[i]) - storage * pressure[i];
          float half_slope = 0.5f * gain[i] * by_flow * fabsf(opening);
          float drop = supply + (opening < 0.0f ? -1.0f : 1.0f) * at_rest * by_flow;
          float flow = gain[i] * opening * drop / (half_slope + sqrtf(half_slope * half_slope + fabsf(drop)));
          const float pressure1 = (flow - at_rest) * by_flow;
          const float v1 = (flow - leakage * pressure1 - storage * (pressure1 - pressure[i])) * per_area;
          const float x1 = x[i] + hs * v1;

          slope = (u - feedback[i] * x1 - e) * per_stage;
          deviation = p[i] - e + lag[i] * slope, rate_deviation = r[i] - slope;
          spool = p[i] + slope * h + yy[i] * deviation + yr[i] * rate_deviation;
          r[i] += ry[i] * deviation + rr[i] * rate_deviation;
          p[i] = spool;

          const float xs = x[i] + carried * (x1 - x[i]), vs = v[i] + carried * (v1 - v[i]);
          const float ps = pressure[i] + carried * (pressure1 - pressure[i]);
          opening = clip(spool - clip(spool, dead[i]), limit[i]);
          at_rest = by_momentum * (mass * vs - hs * stiffness * xs) - storage * ps;
          half_slope = 0.5f * gain[i] * by_flow * fabsf(opening);
          drop = supply + (opening < 0.0f ? -1.0f : 1.0f) * at_rest * by_flow;
          flow = gain[i] * opening * drop / (half_slope + sqrtf(half_slope * half_slope + fabsf(drop)));
          pressure[i] = (flow - at_rest) * by_flow;
          v[i] = (flow - leakage * pressure[i] - storage * (pressure[i] - ps)) * per_area;
          x[i] = xs + hs * v[i];
        }
      }
    }
    for (int i = 0; i < LANES && block + i < count; i++) cost[block + i] = sum[i];
  }
}
