/* Prints the GF/s of fused multiply-adds on registers alone, on 1 thread and on argv[1] threads: the processor's float32 peak. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#if defined(__AVX512F__)
enum { BYTES = 64, CHAINS = 16 };
#elif defined(__AVX2__)
enum { BYTES = 32, CHAINS = 12 };
#else
enum { BYTES = 16, CHAINS = 12 };
#endif
enum { STEPS = 1 << 22, LANES = BYTES / 4 };
typedef float vector __attribute__((vector_size(BYTES)));

static void *chains(void *result) {
  vector sum[CHAINS], a, b;
  for (int j = 0; j < LANES; j++) a[j] = 0.999f, b[j] = 1e-3f;
#pragma GCC unroll 16
  for (int i = 0; i < CHAINS; i++) sum[i] = a + (float)i;
  for (int step = 0; step < STEPS; step++)
#pragma GCC unroll 16
    for (int i = 0; i < CHAINS; i++) sum[i] = sum[i] * a + b;
  for (int i = 0; i < CHAINS; i++) *(float *)result += sum[i][0];
  return NULL;
}

static double seconds(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double best_rate(int threads) {
  pthread_t thread[256];
  float results[256][32] = {{0}}; /* a cache line each */
  double best = 0;
  for (int repeat = 0; repeat < 10; repeat++) {
    const double start = seconds();
    for (int i = 0; i < threads; i++)
      if (pthread_create(&thread[i], NULL, chains, results[i])) exit(1);
    for (int i = 0; i < threads; i++) pthread_join(thread[i], NULL);
    const double rate = 2.0 * STEPS * CHAINS * LANES * threads / (seconds() - start) / 1e9;
    if (rate > best) best = rate;
  }
  return best;
}

int main(int argc, char **argv) {
  const int threads = argc > 1 ? atoi(argv[1]) : 1;
  if (threads < 1 || threads > 256) return 2;
  printf("%.1f %.1f\n", best_rate(1), best_rate(threads));
  return 0;
}
