// The Riccati recursion of method/riccati.py with noise and gains: all stages of a chain, backward
// and forward, in one kernel. Names are those of that file; s = 1 / mu.
//
// THREADS threads work on a chain; where they are less than a warp, several chains share one. All
// sizes are macros: REAL, NX, NU, SOFT (there is a penalty), NOISY, TILE, THREADS. Matrices lie in
// shared memory, padded to tiles of TILE x TILE, but those that are eliminated, in registers: the
// first columns of what has S / mu = L L' or Quu at its top. A stage backward is
//
//     [S / mu; P; p']   ->  [L^{-1}; -P~; -t'],     t = (S / mu)^{-1} p = p~ - s P~ lambda
//     [W slope] = P~ [B A h + s lambda] + [0 0 t]
//     [Quu Qxu'; Qxu Qxx; qu' qx'] = [B A slope]' W + H   ->  [. .; K' P; kff' p]
//
// Products have the form X'Y, whose rows lie side by side, with symmetric matrices for their
// transposes; a vector is the first column of a block at the right.

#include "tiles.cuh"

constexpr int BX = blocks(NX), BU = blocks(NU), BZ = BX + BU;
constexpr int PX = BX * TILE, PU = BU * TILE, PZ = BZ * TILE;
constexpr int SZ = PZ + TILE;  // with a block at the right
constexpr int OF_S = SOFT ? triangle(BX) + (BX + 1) * BX : 0, OF_Q = triangle(BZ + 1) - 1;
constexpr int EACH = ((OF_S > OF_Q ? OF_S : OF_Q) + THREADS - 1) / THREADS;
constexpr int PANEL = (2 * BX > BZ ? 2 * BX : BZ) * TILE + TILE;
constexpr int LX = (BX | 1) * TILE, LU = (BU | 1) * TILE;  // odd: rows begin in different banks

// What a stage backward leaves for the way forward: L^{-1}, its transpose, P, p, kff, and the
// noise of u at a given x.
constexpr int L_ROOT = 0, L_TRANSPOSED = SOFT * PX * PX, L_P = 2 * L_TRANSPOSED;
constexpr int L_p = L_P + PX * PX, L_KFF = L_p + PX, L_COLOR = L_KFF + PU;
constexpr int LEFT = (L_COLOR + PU + 3) / 4 * 4;

// Shared memory, in numbers. Vectors of stages that follow each other have a place each.
constexpr int V_LAMBDA = 0, V_XU = PX, V_H = PX + PU, V_p = 2 * PX + PU, V_XE = 3 * PX + PU;
constexpr int V_KFF = 4 * PX + PU, V_COLOR = V_KFF + PU, VECTORS = V_COLOR + PU;
constexpr int M_PANEL = 2 * VECTORS, M_p = M_PANEL + 2 * TILE * PANEL, M_RELAXED = M_p + PX;
constexpr int M_MATRICES = M_RELAXED + PX, BACKWARD = 2 * PX * PX + 2 * PX * SZ;
constexpr int F_A = 0, F_B = F_A + NX * LX, F_K = F_B + NX * LU, F_P = F_K + NU * LX;
constexpr int F_ROOT = F_P + PX * PX, F_TRANSPOSED = F_ROOT + SOFT * PX * PX;
constexpr int F_X = F_TRANSPOSED + SOFT * PX * PX, F_Y = F_X + 2 * PX, F_Z = F_Y + 2 * PX;
constexpr int F_U = F_Z + 2 * PX, FORWARD = F_U + 2 * PU;
constexpr int SHARED = (M_MATRICES + (BACKWARD > FORWARD ? BACKWARD : FORWARD) + 7) / 8 * 8;

// c += X'Y of so many rows, for the columns at X and at Y.
template <int STRIDE_X, int STRIDE_Y>
DEVICE void add_product(Tile& c, const REAL* X, const REAL* Y, int rows) {
  UNROLL_SOME
  for (int k = 0; k < rows; ++k) {
    const Line x = line(X + k * STRIDE_X), y = line(Y + k * STRIDE_Y);
    EACH_ENTRY c[a][b] += x.at[a] * y.at[b];
  }
}

// The sum of M[k][i] v[k] over the rows from..to-1 of the column i that M points at.
template <int STRIDE>
DEVICE REAL down(const REAL* M, const REAL* v, int from, int to) {
  REAL sum = 0;
  UNROLL_SOME
  for (int k = from; k < to; ++k) sum += M[k * STRIDE] * v[k];
  return sum;
}

struct Stage {
  const REAL *A, *B, *h, *gx, *gu, *Hxx, *Hux, *Huu, *multipliers, *xi_u;
};

// A tile of [Huu .; Hux' Hxx; gu' gx'], with ones on the diagonal of what u is padded with.
DEVICE void load_cost(Tile& e, const Stage& at, int row, int column) {
  const int i = row * TILE, j = column * TILE, ix = i - PU, jx = j - PU;
  const bool i_in_u = row < BU, j_in_u = column < BU, below = row == BZ;
  const REAL* from = at.Hxx + ix * NX + jx;
  int by_a = NX, by_b = 1, rows = NX - ix, columns = j_in_u ? NU - j : NX - jx;
  if (j_in_u) from = at.Hux + j * NX + ix, by_a = 1, by_b = NX;
  if (i_in_u) from = at.Huu + i * NU + j, by_a = NU, by_b = 1, rows = NU - i;
  if (below) from = j_in_u ? at.gu + j : at.gx + jx, by_a = 0, by_b = 1, rows = 1;
  EACH_ENTRY e[a][b] = a < rows && b < columns ? from[a * by_a + b * by_b] : REAL(0);
  if (i_in_u && row == column) EACH_ENTRY if (a == b && a >= rows) e[a][b] = 1;
}

DEVICE void backward(const Stage& at, const Places<EACH>& of_s, const Places<EACH>& of_q,
                     REAL* memory, REAL* left, REAL* gains, REAL s, int parity, int thread) {
  const int other = THREADS - 1 - thread;  // vectors, where tiles leave the last threads idle
  REAL *vectors = memory + parity * VECTORS, *panels = memory + M_PANEL;
  REAL *p = memory + M_p, *relaxed = SOFT ? memory + M_RELAXED : p;
  REAL *P = memory + M_MATRICES, *W = P + 2 * PX * PX, *G = W + PX * SZ;
  REAL *P_relaxed = SOFT ? P + PX * PX : P, *of_u = W;
  Tile e[EACH];

  copy_matrix<NX, NU, SZ>(G, at.B, thread);
  copy_matrix<NX, NX, SZ>(G + PU, at.A, thread);
  copy_vector<NX, SZ>(G + PZ, at.h, thread);
  if (SOFT) copy_vector<NX>(vectors + V_LAMBDA, at.multipliers, thread);
  if (NOISY) copy_vector<NU>(vectors + V_XU, at.xi_u, thread);
  commit();
  ROLLED
  for (int c = thread; c < PX * BX; c += THREADS)
    *reinterpret_cast<Line*>(left + L_P + c * TILE) = line(P + c * TILE);
  ROLLED
  for (int i = thread; i < NX; i += THREADS) left[L_p + i] = p[i];

  if (SOFT) {
    EACH_TILE(OF_S) {
      const int row = of_s.row[q], j = of_s.column[q] * TILE, i = row * TILE - (row < BX ? 0 : PX);
      if (row == 2 * BX) {
        EACH_ENTRY e[q][a][b] = a == 0 ? p[j + b] : REAL(0);
        continue;
      }
      const REAL scale = row < BX ? s : REAL(1);
      EACH_ENTRY e[q][a][b] = scale * P[(i + a) * PX + j + b];
      if (row == of_s.column[q]) EACH_ENTRY if (a == b) e[q][a][b] += 1;
    }
    eliminate<BX, OF_S, PANEL>(e, of_s, panels, thread);
    EACH_TILE(OF_S) {
      const int row = of_s.row[q], column = of_s.column[q], j = column * TILE, i = row * TILE;
      if (row < BX) {
        Tile transposed;
        EACH_ENTRY transposed[b][a] = e[q][a][b];
        UNROLL
        for (int a = 0; a < TILE; ++a) {
          write_line(left + L_ROOT + (i + a) * PX + j, e[q][a]);
          write_line(left + L_TRANSPOSED + (j + a) * PX + i, transposed[a]);
        }
      } else if (row == 2 * BX) {
        UNROLL
        for (int b = 0; b < TILE; ++b) relaxed[j + b] = -e[q][0][b];
      } else {
        EACH_ENTRY if (i - PX + a >= j + b)
          P_relaxed[(i - PX + a) * PX + j + b] = P_relaxed[(j + b) * PX + i - PX + a] = -e[q][a][b];
      }
    }
  }
  wait<0>();
  if (SOFT)  // P~ h + p~ = P~ (h + s lambda) + T p; this thread has copied both
    for (int i = thread; i < NX; i += THREADS) G[i * SZ + PZ] += s * vectors[V_LAMBDA + i];
  sync();

  EACH_TILE(OF_Q) load_cost(e[q], at, of_q.row[q], of_q.column[q]);  // arrives meanwhile
  for (int t = thread; t < BX * (BZ + 1); t += THREADS) {
    const int i = t / (BZ + 1) * TILE, j = t % (BZ + 1) * TILE;
    Tile c = {};
    if (j == PZ)
      UNROLL
      for (int a = 0; a < TILE; ++a) c[a][0] = relaxed[i + a];
    add_product<PX, SZ>(c, P_relaxed + i, G + j, PX);
    EACH_ENTRY W[(i + a) * SZ + j + b] = c[a][b];
  }
  sync();
  EACH_TILE(OF_Q)
    add_product<SZ, SZ>(e[q], W + of_q.row[q] * TILE, G + of_q.column[q] * TILE, PX);
  eliminate<BU, OF_Q, PANEL>(e, of_q, panels, thread);
  EACH_TILE(OF_Q) {
    const int row = of_q.row[q], column = of_q.column[q];
    const int j = column * TILE, ix = row * TILE - PU, jx = j - PU;
    if (row < BU) {
      if (NOISY) EACH_ENTRY of_u[(row * TILE + a) * PU + j + b] = e[q][a][b];
    } else if (row == BZ) {
      UNROLL
      for (int b = 0; b < TILE; ++b) {
        if (column < BU && j + b < NU) left[L_KFF + j + b] = e[q][0][b];
        if (column >= BU) p[jx + b] = e[q][0][b];
      }
    } else if (column < BU) {
      EACH_ENTRY if (ix + a < NX && j + b < NU) gains[(j + b) * NX + ix + a] = e[q][a][b];
    } else {
      EACH_ENTRY if (ix + a >= jx + b)
        P[(ix + a) * PX + jx + b] = P[(jx + b) * PX + ix + a] = e[q][a][b];
    }
  }
  sync();
  if (NOISY)
    for (int j = other; j < NU; j += THREADS)
      left[L_COLOR + j] = down<PU>(of_u + j, vectors + V_XU, j / TILE * TILE, NU);
}

enum Shape { FULL, LOWER, UPPER };

// M v for the step, and for the noise beside it at v + BESIDE, for a matrix of ROWS rows of COUNT
// lines; done(row, step, noise) takes each entry. Neighbouring threads share a row.
template <int ROWS, int COUNT, int STRIDE, int BESIDE, Shape SHAPE, class Done>
DEVICE void products_with(const REAL* M, const REAL* v, int thread, Done done) {
  constexpr int LIMIT = THREADS / ROWS < COUNT ? THREADS / ROWS : COUNT;
  constexpr int PARTS = LIMIT >= 8 ? 8 : LIMIT >= 4 ? 4 : LIMIT >= 2 ? 2 : 1;
  ROLLED
  for (int first = 0; first < ROWS; first += THREADS / PARTS) {
    const int row = first + thread / PARTS, part = thread % PARTS;
    const int begin = SHAPE == UPPER ? row / TILE : 0;
    const int end = row >= ROWS ? 0 : SHAPE == LOWER ? row / TILE + 1 : COUNT;
    REAL step = 0, noise = 0;
    ROLLED
    for (int c = begin + part; c < end; c += PARTS) {
      const Line m = line(M + row * STRIDE + c * TILE), x = line(v + c * TILE);
      UNROLL
      for (int a = 0; a < TILE; ++a) step += m.at[a] * x.at[a];
      if (NOISY) {
        const Line n = line(v + BESIDE + c * TILE);
        UNROLL
        for (int a = 0; a < TILE; ++a) noise += m.at[a] * n.at[a];
      }
    }
    UNROLL
    for (int by = 1; by < PARTS; by *= 2) {
      step += shuffled(step, by);
      if (NOISY) noise += shuffled(noise, by);
    }
    if (row < ROWS && part == 0) done(row, step, noise);
  }
}

extern "C" KERNEL void newton(
    const REAL* A, const REAL* B, const REAL* h, const REAL* gx, const REAL* gu, const REAL* Hxx,
    const REAL* Hux, const REAL* Huu, const REAL* multipliers,
#if SOFT
    const REAL* penalty,
#endif
#if NOISY
    const REAL* xi_u, const REAL* xi_e,
#endif
    REAL* dx, REAL* du, REAL* rate, REAL* gains,
#if NOISY
    REAL* noise_x, REAL* noise_u,
#endif
    REAL* left, int rows, int horizon) {
#if !NOISY
  const REAL *xi_u = nullptr, *xi_e = nullptr;
  REAL *noise_x = nullptr, *noise_u = nullptr;
#endif
  const int thread = THREAD % THREADS, group = THREAD / THREADS;
  const int wanted = BLOCK * (BLOCK_SIZE / THREADS) + group;
  const long row = wanted < rows ? wanted : rows - 1;  // the last chain may be done twice
  const long first = row * horizon, first_cost = row * (horizon + 1);
  REAL *memory = MEMORY + group * SHARED, *matrices = memory + M_MATRICES, *p = memory + M_p;
#if SOFT
  const REAL s = REAL(1) / penalty[row];
#else
  const REAL s = 0;
#endif
  const REAL root_s = sqrt(s);
  left += first * LEFT;
  gains += first * NU * NX;

  for (int i = thread; i < SHARED; i += THREADS) memory[i] = 0;
  sync();
  const REAL* end = Hxx + (first_cost + horizon) * NX * NX;
  for (int i = thread; i < NX * NX; i += THREADS) matrices[i / NX * PX + i % NX] = end[i];
  for (int i = thread; i < NX; i += THREADS) p[i] = gx[(first_cost + horizon) * NX + i];
  sync();
  const Places<EACH> of_s(BX, thread), of_q(BZ + 1, thread);
  ROLLED
  for (int k = horizon - 1; k >= 0; --k) {
    const long at = first + k, cost = first_cost + k;
    const Stage stage = {A + at * NX * NX,   B + at * NX * NU,   h + at * NX,
                         gx + cost * NX,     gu + at * NU,       Hxx + cost * NX * NX,
                         Hux + at * NU * NX, Huu + at * NU * NU, multipliers + at * NX,
                         xi_u + at * NU};
    backward(stage, of_s, of_q, memory, left + long(k) * LEFT, gains + long(k) * NU * NX, s, k & 1,
             thread);
  }
  sync();

  REAL *x = matrices + F_X, *y = matrices + F_Y, *z = matrices + F_Z, *u = matrices + F_U;
  for (int i = thread; i < SHARED; i += THREADS) memory[i] = 0;
  sync();
  auto copy_model = [&](int k) {
    const long at = first + k;
    REAL* vectors = memory + (k & 1) * VECTORS;
    const REAL* of_stage = left + long(k) * LEFT;
    copy_matrix<NX, NX, LX>(matrices + F_A, A + at * NX * NX, thread);
    copy_matrix<NX, NU, LU>(matrices + F_B, B + at * NX * NU, thread);
    copy_matrix<NU, NX, LX>(matrices + F_K, gains + long(k) * NU * NX, thread);
    copy_vector<NX>(vectors + V_H, h + at * NX, thread);
    copy_vector<NX>(vectors + V_LAMBDA, multipliers + at * NX, thread);
    copy_vector<NX>(vectors + V_p, of_stage + L_p, thread);
    copy_vector<NU>(vectors + V_KFF, of_stage + L_KFF, thread);
    if (NOISY && SOFT) copy_vector<NX>(vectors + V_XE, xi_e + at * NX, thread);
    if (NOISY) copy_vector<NU>(vectors + V_COLOR, of_stage + L_COLOR, thread);
  };
  auto copy_squares = [&](int k, int from, int to, int count) {
    copy_matrix<PX, PX, PX>(matrices + to, left + long(k) * LEFT + from, thread);
    if (count == 2)
      copy_matrix<PX, PX, PX>(matrices + to + PX * PX, left + long(k) * LEFT + from + PX * PX,
                              thread);
  };
  copy_model(0);
  if (SOFT) copy_squares(0, L_ROOT, F_ROOT, 2);
  commit();
  ROLLED
  for (int k = 0; k < horizon; ++k) {
    const REAL* of = memory + (k & 1) * VECTORS;
    const bool more = k + 1 < horizon;
    const long at = first + k;
    wait<0>();
    sync();
    copy_squares(k, L_P, F_P, 1);
    commit();
    products_with<NU, BX, LX, PX, FULL>(
        matrices + F_K, x, thread, [&](int j, REAL step, REAL noise) {
          u[j] = du[at * NU + j] = step + of[V_KFF + j];
          if (NOISY) u[PU + j] = noise_u[at * NU + j] = noise + of[V_COLOR + j];
        });
    products_with<NX, BX, LX, PX, FULL>(
        matrices + F_A, x, thread, [&](int i, REAL step, REAL noise) {
          z[i] = step + of[V_H + i] + s * (of[V_LAMBDA + i] - of[V_p + i]);
          if (NOISY) z[PX + i] = noise;
        });
    sync();
    products_with<NX, BU, LU, PU, FULL>(
        matrices + F_B, u, thread, [&](int i, REAL step, REAL noise) {
          y[i] = z[i] + step;
          if (NOISY) y[PX + i] = z[PX + i] + noise;
        });
    sync();
    if (more) copy_model(k + 1);
    commit();
    if (SOFT) {
      products_with<NX, BX, PX, PX, LOWER>(
          matrices + F_ROOT, y, thread, [&](int i, REAL step, REAL noise) {
            z[i] = step;
            if (NOISY) z[PX + i] = noise - root_s * of[V_XE + i];
          });
      sync();
    }
    auto moved = [&](int i, REAL step, REAL noise) {
      x[i] = dx[at * NX + i] = step;
      if (NOISY) x[PX + i] = noise_x[at * NX + i] = noise;
    };
    if (SOFT) products_with<NX, BX, PX, PX, UPPER>(matrices + F_TRANSPOSED, z, thread, moved);
    else for (int i = thread; i < NX; i += THREADS) moved(i, y[i], y[PX + i]);
    wait<1>();
    sync();
    if (SOFT && more) copy_squares(k + 1, L_ROOT, F_ROOT, 2);
    commit();
    products_with<NX, BX, PX, PX, FULL>(matrices + F_P, x, thread, [&](int i, REAL step, REAL) {
      rate[at * NX + i] = step + of[V_p + i] - of[V_LAMBDA + i];
    });
  }
}
