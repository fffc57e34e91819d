// Newton's method of constraint_solver.py without cones, all iterations of a state in one kernel.
// Names are those of that file.
//
// A block of THREADS threads works on a state. Sizes are macros: REAL, NV, NEFC (of J), TILE,
// THREADS, and ITERATIONS, SIZES and DIGITS of that file. An iteration eliminates
//
//     [H; g']  ->  [. ; -g' H^{-1}]
//
// whose sums go over the rows of J that push or bend alone; most contacts of a robot are open.

#include "tiles.cuh"

constexpr int BV = blocks(NV), PV = BV * TILE;
constexpr int LV = (BV | 1) * TILE;  // odd: rows begin in different banks
constexpr int COUNT = triangle(BV) + BV, EACH = (COUNT + THREADS - 1) / THREADS;
constexpr int PANEL = (BV + 1) * TILE, WARPS = THREADS / 32;

// Shared memory, in numbers.
constexpr int M_M = 0, M_J = M_M + PV * LV, M_PANEL = M_J + NEFC * LV;
constexpr int M_A = M_PANEL + 2 * TILE * PANEL, M_REST = M_A + PV, M_PULL = M_REST + PV;
constexpr int M_GRADIENT = M_PULL + PV, M_DIRECTION = M_GRADIENT + PV, M_ALONG = M_DIRECTION + PV;
constexpr int M_D = M_ALONG + PV, M_LOWER = M_D + NEFC, M_UPPER = M_LOWER + NEFC;
constexpr int M_Y = M_UPPER + NEFC, M_H = M_Y + NEFC, M_PUSH = M_H + NEFC, M_BEND = M_PUSH + NEFC;
constexpr int M_SUMS = M_BEND + NEFC, M_ACTIVE = M_SUMS + 2 * SIZES * WARPS;
constexpr int SHARED = (M_ACTIVE + NEFC + 7) / 8 * 8;

constexpr REAL EPS = sizeof(REAL) == 4 ? REAL(1.1920928955078125e-07) : REAL(2.220446049250313e-16);
constexpr REAL SHORT = DIGITS * EPS * DIGITS * EPS;

DEVICE REAL clipped(REAL y, REAL lower, REAL upper) {  // not a number where y is none
  return y < lower ? lower : y > upper ? upper : y;
}
DEVICE REAL smaller(REAL a, REAL b) { return a < b || b != b ? a : b; }
DEVICE REAL larger(REAL a, REAL b) { return a > b || b != b ? a : b; }

// Of the lanes that differ in the bits below `lanes`; every one of them has the result.
DEVICE REAL sum_of(REAL a, int lanes = 32) {
  UNROLL
  for (int by = lanes / 2; by > 0; by /= 2) a += shuffled(a, by);
  return a;
}
DEVICE REAL least_of(REAL a, int lanes) {
  UNROLL
  for (int by = lanes / 2; by > 0; by /= 2) a = smaller(a, shuffled(a, by));
  return a;
}
DEVICE REAL most_of(REAL a, int lanes) {
  UNROLL
  for (int by = lanes / 2; by > 0; by /= 2) a = larger(a, shuffled(a, by));
  return a;
}

// v'w of the row of a matrix and a vector, both padded.
DEVICE REAL dot(const REAL* v, const REAL* w) {
  REAL sum = 0;
  UNROLL_SOME
  for (int c = 0; c < PV; c += TILE) {
    const Line a = line(v + c), b = line(w + c);
    UNROLL
    for (int i = 0; i < TILE; ++i) sum += a.at[i] * b.at[i];
  }
  return sum;
}

struct Change {
  REAL value, slope;
};

// By how much s changes from y to y + size h, but for the slope at y, and how its slope does.
DEVICE Change change(const REAL* memory, int k, REAL size) {
  const REAL lower = memory[M_LOWER + k], upper = memory[M_UPPER + k], D = memory[M_D + k];
  const REAL y = memory[M_Y + k], h = memory[M_H + k], step = size * h, later = y + step;
  const REAL here = clipped(y, lower, upper), there = clipped(later, lower, upper);
  const REAL moved = here == y && there == later ? step : there - here;
  return {D * moved * (later - there + REAL(0.5) * moved), D * moved * h};
}

extern "C" KERNEL void minimum(const REAL* M, const REAL* J, const REAL* D, const REAL* aref,
                               const REAL* lower, const REAL* upper, const REAL* a0, REAL* a) {
  const int thread = THREAD, lane = thread % 32, warp = thread / 32;
  const long state = BLOCK;
  REAL *memory = MEMORY, *A = memory + M_A, *rest = memory + M_REST, *Y = memory + M_Y;
  REAL *of_h = memory + M_H, *pull = memory + M_PULL, *gradient = memory + M_GRADIENT;
  REAL *direction = memory + M_DIRECTION, *along = memory + M_ALONG, *sums = memory + M_SUMS;
  int* active = reinterpret_cast<int*>(memory + M_ACTIVE);

  for (int i = thread; i < SHARED; i += THREADS) memory[i] = 0;
  sync();
  copy_matrix<NV, NV, LV>(memory + M_M, M + state * NV * NV, thread);
  copy_matrix<NEFC, NV, LV>(memory + M_J, J + state * NEFC * NV, thread);
  copy_vector<NV>(direction, a0 + state * NV, thread);
  copy_vector<NEFC>(memory + M_D, D + state * NEFC, thread);
  copy_vector<NEFC>(memory + M_LOWER, lower + state * NEFC, thread);
  copy_vector<NEFC>(memory + M_UPPER, upper + state * NEFC, thread);
  copy_vector<NEFC>(Y, aref + state * NEFC, thread);
  commit();
  const Places<EACH> places(BV, thread);
  for (int i = NV + thread; i < PV; i += THREADS) memory[M_M + i * LV + i] = 1;
  wait<0>();
  sync();
  for (int k = thread; k < NEFC; k += THREADS) Y[k] = dot(memory + M_J + k * LV, direction) - Y[k];
  sync();

  ROLLED
  for (int count = 0; count < ITERATIONS; ++count) {
    int acting = 0;  // every warp counts, the first one writes
    ROLLED
    for (int first = 0; first < NEFC; first += 32) {
      const int k = first + lane;
      REAL push = 0, bend = 0;
      if (k < NEFC) {
        const REAL y = Y[k], at = clipped(y, memory[M_LOWER + k], memory[M_UPPER + k]);
        push = -memory[M_D + k] * at;
        bend = at == y ? memory[M_D + k] : REAL(0);
      }
      const bool acts = push != 0 || bend != 0;
      const unsigned int all = ballot(acts);
      if (acts && warp == 0) {
        const int place = acting + ones(all & ((1u << lane) - 1));
        active[place] = k;
        memory[M_PUSH + place] = push;
        memory[M_BEND + place] = bend;
      }
      acting += ones(all);
    }
    sync();

    Tile e[EACH];
    EACH_TILE(COUNT) {
      const int row = places.row[q], j = places.column[q] * TILE, i = row * TILE;
      const REAL* of_column = memory + M_J + j;
      if (row == BV) {
        EACH_ENTRY e[q][a][b] = 0;
        UNROLL_SOME
        for (int p = 0; p < acting; ++p) {
          const Line y = line(of_column + active[p] * LV);
          const REAL push = memory[M_PUSH + p];
          UNROLL
          for (int b = 0; b < TILE; ++b) e[q][0][b] += push * y.at[b];
        }
        UNROLL
        for (int b = 0; b < TILE; ++b) {
          pull[j + b] = e[q][0][b];
          gradient[j + b] = e[q][0][b] = rest[j + b] - e[q][0][b];
        }
        continue;
      }
      EACH_ENTRY e[q][a][b] = memory[M_M + (i + a) * LV + j + b];
      UNROLL_SOME
      for (int p = 0; p < acting; ++p) {
        const REAL *of = of_column + active[p] * LV, bend = memory[M_BEND + p];
        const Line x = line(of - j + i), y = line(of);
        EACH_ENTRY e[q][a][b] += bend * x.at[a] * y.at[b];
      }
    }
    eliminate<BV, COUNT, PANEL>(e, places, memory + M_PANEL, thread);
    EACH_TILE(COUNT) if (places.row[q] == BV) {
      UNROLL
      for (int b = 0; b < TILE; ++b) direction[places.column[q] * TILE + b] = -e[q][0][b];
    }
    sync();
    for (int k = thread; k < NEFC + PV; k += THREADS) {
      if (k < NEFC) of_h[k] = -dot(memory + M_J + k * LV, direction);
      else along[k - NEFC] = dot(memory + M_M + (k - NEFC) * LV, direction);
    }
    sync();

    REAL first = 0, second = 0, lost = 0, before = 0;  // the same in every warp
    for (int j = lane; j < PV; j += 32) {
      const REAL d = direction[j];
      first += gradient[j] * d;
      second += d * along[j];
      lost += fabs(d) * (fabs(rest[j]) + fabs(pull[j]));
      before += A[j] * rest[j];
    }
    first = sum_of(first), second = sum_of(second);
    lost = EPS * sum_of(lost), before = sum_of(before);

    const int exponent = thread % SIZES;
    const REAL size = REAL(1) / (1 << exponent);
    Change by_size = {0, 0};
    ROLLED
    for (int k = thread / SIZES; k < NEFC; k += THREADS / SIZES) {
      const Change each = change(memory, k, size);
      by_size.value += each.value, by_size.slope += each.slope;
    }
    UNROLL
    for (int by = SIZES; by < 32; by *= 2)
      by_size.value += shuffled(by_size.value, by), by_size.slope += shuffled(by_size.slope, by);
    if (WARPS > 1) {
      if (lane < SIZES) {
        sums[2 * (warp * SIZES + lane)] = by_size.value;
        sums[2 * (warp * SIZES + lane) + 1] = by_size.slope;
      }
      sync();
      by_size = {0, 0};
      for (int w = 0; w < WARPS; ++w) {
        by_size.value += sums[2 * (w * SIZES + exponent)];
        by_size.slope += sums[2 * (w * SIZES + exponent) + 1];
      }
    }
    const REAL value = size * (REAL(0.5) * size * second - first) + by_size.value;
    const REAL slope = size * second - first + by_size.slope;

    // Where the slope is about 0, between the last size where it falls and the first where it rises
    const REAL far = least_of(slope > 0 ? size : REAL(2), SIZES);
    const REAL near = most_of(slope > 0 ? REAL(0) : size, SIZES);
    const REAL at_far = sum_of(size == far ? slope : REAL(0), SIZES);
    const REAL near_slope = sum_of(size == near ? slope : REAL(0), SIZES);
    const REAL at_near = near > 0 ? near_slope : -first;
    const bool bracketed = at_far > at_near && far < 2;
    const REAL flat = bracketed ? near - at_near / (at_far - at_near) * (far - near) : REAL(1);
    REAL between = 0;
    for (int k = lane; k < NEFC; k += 32) between += change(memory, k, flat).value;
    between = flat * (REAL(0.5) * flat * second - first) + sum_of(between);
    REAL least = least_of(value, SIZES);
    REAL chosen = most_of(value == least ? size : REAL(0), SIZES);
    if (between < least) least = between, chosen = flat;
    if (!(-least > lost)) chosen = 0;
    const bool unfinished = -least > lost && -least > SHORT * before;
    sync();  // all have read what changes now
    for (int j = thread; j < PV; j += THREADS) {
      A[j] -= chosen * direction[j];
      rest[j] -= chosen * along[j];
    }
    for (int k = thread; k < NEFC; k += THREADS) Y[k] += chosen * of_h[k];
    sync();
    if (!unfinished) break;
  }
  for (int j = thread; j < NV; j += THREADS) a[state * NV + j] = a0[state * NV + j] + A[j];
}
