// What `mjx_drax/kernels/*.cu` takes from CUDA, on a CPU: a block is a group of threads that wait
// for each other at a barrier.
#include <barrier>
#include <cmath>
#include <thread>
#include <vector>

#define DEVICE inline
#define KERNEL
#define UNROLL
#define UNROLL_SOME
#define ROLLED

static thread_local int BLOCK, THREAD;
static thread_local REAL* MEMORY;
static thread_local std::barrier<>* others;
static thread_local std::vector<REAL>* lanes;

inline REAL inverse_root(REAL a) { return 1 / std::sqrt(a); }
inline void sync() { others->arrive_and_wait(); }
inline REAL shuffled(REAL a, int by) {
  (*lanes)[THREAD] = a;
  sync();
  const REAL other = (*lanes)[THREAD ^ by];
  sync();
  return other;
}
inline unsigned int ballot(bool a) {
  (*lanes)[THREAD] = a;
  sync();
  unsigned int bits = 0;
  for (int i = 0; i < 32; ++i) bits |= (*lanes)[THREAD / 32 * 32 + i] != 0 ? 1u << i : 0;
  sync();
  return bits;
}
inline int ones(unsigned int bits) { return __builtin_popcount(bits); }
template <int BYTES>
void copy(REAL* to, const REAL* from) {
  for (size_t i = 0; i < BYTES / sizeof(REAL); ++i) to[i] = from[i];
}
inline void commit() {}
template <int>
void wait() {}

template <class Kernel>
void launch(int blocks, int threads, int shared, Kernel kernel) {
  for (int block = 0; block < blocks; ++block) {
    std::barrier<> gate(threads);
    std::vector<REAL> memory(shared + 8, NAN), exchanged(threads);
    std::vector<std::thread> group;
    for (int i = 0; i < threads; ++i)
      group.emplace_back([&, i] {
        BLOCK = block, THREAD = i, others = &gate, lanes = &exchanged;
        MEMORY = reinterpret_cast<REAL*>((reinterpret_cast<size_t>(memory.data()) + 31) / 32 * 32);
        kernel();
      });
    for (auto& thread : group) thread.join();
  }
}
