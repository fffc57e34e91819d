// What kernels of this folder share: tiles of matrices in registers, and their elimination.
//
// THREADS threads, in blocks of at least a warp, work on a problem. REAL, TILE and THREADS are
// macros; tests give what CUDA has in `cuda_on_cpu.h`.

constexpr int BLOCK_SIZE = THREADS < 32 ? 32 : THREADS;

#ifdef __CUDACC__
#define DEVICE __device__ __forceinline__
#define KERNEL __global__ __launch_bounds__(BLOCK_SIZE)
#define BLOCK blockIdx.x
#define THREAD threadIdx.x
#define UNROLL _Pragma("unroll")
#define UNROLL_SOME _Pragma("unroll 4")
#define ROLLED _Pragma("unroll 1")
extern __shared__ __align__(32) REAL MEMORY[];
DEVICE float inverse_root(float a) { return rsqrtf(a); }
DEVICE double inverse_root(double a) { return rsqrt(a); }
DEVICE void sync() {
  if (THREADS <= 32) __syncwarp();
  else __syncthreads();
}
DEVICE REAL shuffled(REAL a, int by) { return __shfl_xor_sync(0xffffffff, a, by); }
DEVICE unsigned int ballot(bool a) { return __ballot_sync(0xffffffff, a); }
DEVICE int ones(unsigned int bits) { return __popc(bits); }
template <int BYTES>
DEVICE void copy(REAL* to, const REAL* from) {  // asynchronous: see wait()
  unsigned int shared = static_cast<unsigned int>(__cvta_generic_to_shared(to));
  asm volatile("cp.async.ca.shared.global [%0], [%1], %2;" ::"r"(shared), "l"(from), "n"(BYTES)
               : "memory");
}
DEVICE void commit() { asm volatile("cp.async.commit_group;" ::: "memory"); }  // of copies
template <int NEWER>
DEVICE void wait() {  // until all groups but so many newer ones have arrived
  asm volatile("cp.async.wait_group %0;" ::"n"(NEWER) : "memory");
}
#endif

struct alignas(TILE * sizeof(REAL)) Line {
  REAL at[TILE];
};
using Tile = REAL[TILE][TILE];

DEVICE constexpr int blocks(int n) { return (n + TILE - 1) / TILE; }
DEVICE constexpr int triangle(int n) { return n * (n + 1) / 2; }

// Which tiles of a matrix are in the registers of a thread: the q-th is number thread + q THREADS
// of a lower triangle of `square` blocks of rows, row by row, and of full rows below it.
template <int EACH>
struct Places {
  int row[EACH], column[EACH];

  DEVICE Places(int square, int thread) {
    for (int q = 0; q < EACH; ++q) {
      const int t = thread + q * THREADS, below = t - triangle(square);
      int r = 0;
      while (triangle(r + 1) <= t) ++r;
      row[q] = below < 0 ? r : square + below / square;
      column[q] = below < 0 ? t - triangle(r) : below % square;
    }
  }
};

#define EACH_TILE(count) \
  UNROLL                 \
  for (int q = 0; q < ((count) + THREADS - 1) / THREADS; ++q) if (thread + q * THREADS < (count))
#define EACH_ENTRY                \
  UNROLL                          \
  for (int a = 0; a < TILE; ++a) \
    UNROLL                        \
    for (int b = 0; b < TILE; ++b)

DEVICE void write_line(REAL* to, const REAL (&row)[TILE]) {
  Line found;
  UNROLL
  for (int b = 0; b < TILE; ++b) found.at[b] = row[b];
  *reinterpret_cast<Line*>(to) = found;
}
DEVICE Line line(const REAL* at) { return *reinterpret_cast<const Line*>(at); }

// L^{-1}, for a symmetric tile L L'; not finite if the tile is not positive definite.
DEVICE void invert_root(Tile& t) {
  UNROLL
  for (int k = 0; k < TILE; ++k) {
    const REAL root = inverse_root(t[k][k]);
    REAL l[TILE];
    UNROLL
    for (int i = k + 1; i < TILE; ++i) l[i] = t[i][k] * root;
    UNROLL
    for (int j = 0; j < k; ++j) t[k][j] *= root;
    t[k][k] = root;
    UNROLL
    for (int i = k + 1; i < TILE; ++i) {
      UNROLL
      for (int j = 0; j < k; ++j) t[i][j] -= l[i] * t[k][j];
      t[i][k] = -l[i] * root;
      UNROLL
      for (int j = k + 1; j <= i; ++j) t[i][j] -= l[i] * l[j];
    }
  }
  EACH_ENTRY if (b > a) t[a][b] = 0;
}

// Gauss elimination of the first PIVOTS blocks of rows of [S11 S21'; S21 S22], of which e are tiles
// of the lower triangle, in place: it leaves L^{-1}, where S11 = L L', and below it -S21 S11^{-1}
// and S22 - S21 S11^{-1} S21'. Step k takes the rows of block k, times the L^{-1} of its tile, from
// all rows below; what the identity beside S11 turns into takes the places of zeros. Threads share
// the block's rows, as they are before; those beyond the diagonal are columns below it.
template <int PIVOTS, int COUNT, int PANEL, int EACH>
DEVICE void eliminate(Tile (&e)[EACH], const Places<EACH>& places, REAL* panels, int thread) {
  ROLLED
  for (int k = 0; k < PIVOTS; ++k) {
    REAL* panel = panels + k % 2 * TILE * PANEL;
    EACH_TILE(COUNT) {
      const int row = places.row[q], column = places.column[q];
      if (row == k) EACH_ENTRY panel[a * PANEL + column * TILE + b] = e[q][a][b];
      if (row > k && column == k) EACH_ENTRY panel[b * PANEL + row * TILE + a] = e[q][a][b];
    }
    sync();
    Tile d;
    UNROLL
    for (int a = 0; a < TILE; ++a) {
      const Line of_d = line(panel + a * PANEL + k * TILE);
      UNROLL
      for (int b = 0; b < TILE; ++b) d[a][b] = of_d.at[b];
    }
    invert_root(d);
    EACH_TILE(COUNT) {
      const int row = places.row[q], column = places.column[q];
      if (row < k) continue;
      Tile above = {};  // L^{-1} times the block's rows: of the identity in column k
      if (column == k) {
        EACH_ENTRY above[a][b] = d[a][b];
      } else {
        UNROLL
        for (int c = 0; c < TILE; ++c) {
          const Line y = line(panel + c * PANEL + column * TILE);
          UNROLL
          for (int a = c; a < TILE; ++a)
            UNROLL
            for (int b = 0; b < TILE; ++b) above[a][b] += d[a][c] * y.at[b];
        }
      }
      if (row == k) {
        EACH_ENTRY e[q][a][b] = above[a][b];
        continue;
      }
      Tile factor = {};  // (L^{-1} times the block's rows in the columns of this row)'
      UNROLL
      for (int c = 0; c < TILE; ++c) {
        const Line x = line(panel + c * PANEL + row * TILE);
        UNROLL
        for (int a = 0; a < TILE; ++a)
          UNROLL
          for (int b = c; b < TILE; ++b) factor[a][b] += x.at[a] * d[b][c];
      }
      EACH_ENTRY {
        REAL sum = column == k ? REAL(0) : e[q][a][b];
        UNROLL
        for (int c = 0; c < TILE; ++c) sum -= factor[a][c] * above[c][b];
        e[q][a][b] = sum;
      }
    }
  }
}

template <int COLUMNS>
DEVICE constexpr int bytes() {  // of one copy: rows begin at multiples of them
  return COLUMNS % 4 == 0 && TILE == 4 && sizeof(REAL) == 4 ? 16
         : COLUMNS % 2 == 0 && TILE % 2 == 0 ? (sizeof(REAL) == 4 ? 8 : 16) : sizeof(REAL);
}

template <int ROWS, int COLUMNS, int STRIDE>
DEVICE void copy_matrix(REAL* to, const REAL* from, int thread) {
  constexpr int BYTES = bytes<COLUMNS>(), EACH_COPY = BYTES / sizeof(REAL);
  constexpr int IN_ROW = COLUMNS / EACH_COPY;
  ROLLED
  for (int c = thread; c < ROWS * IN_ROW; c += THREADS)
    copy<BYTES>(to + c / IN_ROW * STRIDE + c % IN_ROW * EACH_COPY, from + c * EACH_COPY);
}

template <int COUNT, int STRIDE = 1>
DEVICE void copy_vector(REAL* to, const REAL* from, int thread) {
  ROLLED
  for (int i = thread; i < COUNT; i += THREADS) copy<sizeof(REAL)>(to + i * STRIDE, from + i);
}
