// Newton's method of constraint_solver.py, all iterations of a state in one kernel. Names are those
// of that file, and of elliptic_cones.py.
//
// A block of THREADS threads works on a state. Sizes are macros: REAL, NV, NLAW (rows of J without
// cones), C3, C4 and C6 (contacts with cones of so many rows, which follow in that order), TILE,
// THREADS, and ITERATIONS, SIZES and DIGITS of that file. An iteration eliminates
//
//     [H; g']  ->  [. ; -g' H^{-1}]
//
// whose sums go over the rows of J that push or bend alone; most contacts of a robot are open. A
// cone that slides adds two rows to them, J' times the slope of w and times its direction.

#include "tiles.cuh"

constexpr int BV = blocks(NV), PV = BV * TILE;
constexpr int LV = (BV | 1) * TILE;  // odd: rows begin in different banks
constexpr int COUNT = triangle(BV) + BV, EACH = (COUNT + THREADS - 1) / THREADS;
constexpr int PANEL = (BV + 1) * TILE, WARPS = THREADS / 32;
constexpr int CONTACTS = C3 + C4 + C6, NCONE = 3 * C3 + 4 * C4 + 6 * C6, NEFC = NLAW + NCONE;
constexpr int MOST = C6 ? 6 : C4 ? 4 : 3, TERMS = NEFC + 2 * CONTACTS;

// Shared memory, in numbers.
constexpr int M_M = 0, M_J = M_M + PV * LV, M_PANEL = M_J + TERMS * LV;
constexpr int M_A = M_PANEL + 2 * TILE * PANEL, M_REST = M_A + PV, M_PULL = M_REST + PV;
constexpr int M_GRADIENT = M_PULL + PV, M_DIRECTION = M_GRADIENT + PV, M_ALONG = M_DIRECTION + PV;
constexpr int M_D = M_ALONG + PV, M_LOWER = M_D + NLAW, M_UPPER = M_LOWER + NLAW;
constexpr int M_SCALE = M_UPPER + NLAW, M_MU = M_SCALE + NCONE, M_WEIGHT = M_MU + CONTACTS;
constexpr int M_FALLS = M_WEIGHT + CONTACTS, M_TURNS = M_FALLS + NCONE, M_Y = M_TURNS + NCONE;
constexpr int M_H = M_Y + NEFC, M_PUSH = M_H + NEFC, M_BEND = M_PUSH + TERMS;
constexpr int M_SUMS = M_BEND + TERMS, M_ACTIVE = M_SUMS + 2 * SIZES * WARPS;
constexpr int SHARED = (M_ACTIVE + TERMS + 7) / 8 * 8;

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

// The rows of a contact with a cone: the first of all that have one, and how many.
struct Rows {
  int first, count;
};
DEVICE Rows rows_of(int contact) {
  if (contact < C3) return {3 * contact, 3};
  if (contact < C3 + C4) return {3 * C3 + 4 * (contact - C3), 4};
  return {3 * C3 + 4 * C4 + 6 * (contact - C3 - C4), 6};
}
#define EACH_ROW \
  UNROLL         \
  for (int i = 0; i < MOST; ++i) if (i < rows.count)

enum Zone { OPEN, SLIDES, STICKS };

struct Place {
  Zone zone;
  REAL T, w, u[MOST], along[MOST], P[MOST];
};

// Where u is, with its |t|; tangents are the rows after the first.
DEVICE void place(Place& at, const Rows& rows, REAL mu, REAL T) {
  const REAL N = at.u[0];
  at.T = T, at.w = (N - mu * T) / (1 + mu * mu);
  at.zone = mu * N + T <= 0 ? STICKS : mu * T > N ? SLIDES : OPEN;
  EACH_ROW {
    at.along[i] = i == 0 ? REAL(0) : at.u[i] / (T > 0 ? T : REAL(1));
    const REAL on_cone = i == 0 ? at.w : -mu * at.w * at.along[i];
    at.P[i] = at.zone == STICKS ? at.u[i] : at.zone == SLIDES ? on_cone : REAL(0);
  }
}

DEVICE void place_now(Place& at, const Rows& rows, const REAL* memory, REAL mu) {
  REAL squared = 0;
  EACH_ROW {
    const REAL u = memory[M_SCALE + rows.first + i] * memory[M_Y + NLAW + rows.first + i];
    at.u[i] = u;
    if (i > 0) squared += u * u;
  }
  place(at, rows, mu, sqrt(squared));
}

// The same as `change`, of a contact: see `changes` of elliptic_cones.py.
DEVICE Change change_of_cone(const REAL* memory, int contact, REAL size) {
  const Rows rows = rows_of(contact);
  const REAL mu = memory[M_MU + contact], g = memory[M_WEIGHT + contact], soft = 1 + mu * mu;
  Place at, later;
  place_now(at, rows, memory, mu);
  REAL step[MOST], turn = 0, square = 0;
  EACH_ROW {
    const REAL along = memory[M_SCALE + rows.first + i] * memory[M_H + NLAW + rows.first + i];
    step[i] = size * along;
    later.u[i] = at.u[i] + step[i];
    if (i > 0) turn += along * at.u[i], square += along * along;
  }
  const REAL more = size * (2 * turn + size * square), before = at.T * at.T;
  const REAL T = sqrt(larger(before + more, EPS * (before + size * size * square)));
  place(later, rows, mu, T);
  const REAL longer = more / (at.T + T > 0 ? at.T + T : REAL(1));
  const REAL faster = (step[0] - mu * longer) / soft;
  const bool slides = at.zone == SLIDES && later.zone == SLIDES;
  const bool sticks = at.zone == STICKS && later.zone == STICKS;
  REAL squared = 0, turned = 0, inner = 0, slope = 0;
  EACH_ROW {
    const REAL bent = i == 0 ? 0 : (step[i] - at.along[i] * longer) / (T > 0 ? T : REAL(1));
    const REAL slid = i == 0 ? faster : -mu * (faster * later.along[i] + at.w * bent);
    const REAL moved = slides ? slid : sticks ? step[i] : later.P[i] - at.P[i];
    const int row = rows.first + i;
    squared += moved * moved, turned += bent * bent;
    inner += at.P[i] * (later.u[i] - later.P[i]);
    slope += g * memory[M_SCALE + row] * moved * memory[M_H + NLAW + row];
  }
  if (slides) inner = REAL(0.5) * mu * at.w * (mu * later.u[0] + T) / soft * turned;
  return {g * (REAL(0.5) * squared - inner), slope};
}

// Of a row without a cone, or after these of a contact with one.
DEVICE Change change_of(const REAL* memory, int k, REAL size) {
  return k < NLAW ? change(memory, k, size) : change_of_cone(memory, k - NLAW, size);
}

// What contacts with cones add to the rows that push or bend; every lane has one of them.
DEVICE int add_cones(REAL* memory, int* active, int acting, int warp, int lane) {
  ROLLED
  for (int first = 0; first < CONTACTS; first += 32) {
    const int contact = first + lane;
    const Rows rows = rows_of(contact);
    Place at;
    at.zone = OPEN;
    if (contact < CONTACTS) place_now(at, rows, memory, memory[M_MU + contact]);
    const bool acts = at.zone != OPEN, slides = at.zone == SLIDES;
    const unsigned int in_3 = ballot(acts && rows.count == 3);
    const unsigned int in_4 = ballot(acts && rows.count == 4);
    const unsigned int in_6 = ballot(acts && rows.count == 6);
    const unsigned int sliding = ballot(slides), below = (1u << lane) - 1;
    if (acts && warp == 0) {
      const REAL mu = memory[M_MU + contact], g = memory[M_WEIGHT + contact];
      const REAL share = g / (1 + mu * mu);
      const REAL bent = slides ? share * mu * (mu * at.T - at.u[0]) / at.T : REAL(0);
      int to = acting + 3 * ones(in_3 & below) + 4 * ones(in_4 & below) + 6 * ones(in_6 & below);
      to += 2 * ones(sliding & below);
      EACH_ROW {
        const int row = rows.first + i;
        const REAL scale = memory[M_SCALE + row];
        active[to] = NLAW + row;
        memory[M_PUSH + to] = -g * scale * at.P[i];
        memory[M_BEND + to] = scale * scale * (slides ? (i == 0 ? REAL(0) : bent) : g);
        memory[M_FALLS + row] = scale * (i == 0 ? REAL(1) : -mu * at.along[i]);
        memory[M_TURNS + row] = scale * at.along[i];
        ++to;
      }
      if (slides) {
        active[to] = NEFC + 2 * contact, active[to + 1] = NEFC + 2 * contact + 1;
        memory[M_PUSH + to] = memory[M_PUSH + to + 1] = 0;
        memory[M_BEND + to] = share, memory[M_BEND + to + 1] = -bent;
      }
    }
    acting += 3 * ones(in_3) + 4 * ones(in_4) + 6 * ones(in_6) + 2 * ones(sliding);
  }
  return acting;
}

// The two rows of contacts that slide; of the others they are not read.
DEVICE void combine_rows(REAL* memory, int thread) {
  ROLLED
  for (int t = thread; t < CONTACTS * BV; t += THREADS) {
    const int contact = t / BV, column = t % BV * TILE;
    const Rows rows = rows_of(contact);
    REAL falls[TILE] = {}, turns[TILE] = {};
    ROLLED
    for (int i = 0; i < rows.count; ++i) {
      const Line J = line(memory + M_J + (NLAW + rows.first + i) * LV + column);
      const REAL of_w = memory[M_FALLS + rows.first + i], along = memory[M_TURNS + rows.first + i];
      UNROLL
      for (int b = 0; b < TILE; ++b) falls[b] += of_w * J.at[b], turns[b] += along * J.at[b];
    }
    REAL* to = memory + M_J + (NEFC + 2 * contact) * LV + column;
    write_line(to, falls);
    write_line(to + LV, turns);
  }
}

extern "C" KERNEL void minimum(const REAL* M, const REAL* J, const REAL* D, const REAL* aref,
                               const REAL* lower, const REAL* upper, const REAL* a0,
#if C3 + C4 + C6
                               const REAL* scale, const REAL* mu, const REAL* weight,
#endif
                               REAL* a) {
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
  copy_vector<NLAW>(memory + M_D, D + state * NLAW, thread);
  copy_vector<NLAW>(memory + M_LOWER, lower + state * NLAW, thread);
  copy_vector<NLAW>(memory + M_UPPER, upper + state * NLAW, thread);
  copy_vector<NEFC>(Y, aref + state * NEFC, thread);
#if C3 + C4 + C6
  copy_vector<NCONE>(memory + M_SCALE, scale + state * NCONE, thread);
  copy_vector<CONTACTS>(memory + M_MU, mu + state * CONTACTS, thread);
  copy_vector<CONTACTS>(memory + M_WEIGHT, weight + state * CONTACTS, thread);
#endif
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
    for (int first = 0; first < NLAW; first += 32) {
      const int k = first + lane;
      REAL push = 0, bend = 0;
      if (k < NLAW) {
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
    acting = add_cones(memory, active, acting, warp, lane);
    sync();
    if (CONTACTS) {
      combine_rows(memory, thread);
      sync();
    }

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
    for (int k = thread / SIZES; k < NLAW + CONTACTS; k += THREADS / SIZES) {
      const Change each = change_of(memory, k, size);
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
    for (int k = lane; k < NLAW + CONTACTS; k += 32) between += change_of(memory, k, flat).value;
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
