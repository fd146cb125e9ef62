/* counting_sort against its definition. */
#include "problems.h"

static void check_sort(const ast_kernels *kernels, const int64_t *index, int64_t M, int64_t N) {
  int64_t *order = new_ints(M), *offsets = new_ints(N + 1), place = 0;
  READ_ONLY(index);
  CHECK(kernels->counting_sort(index, M, N, order, offsets) == AST_OK, "status");
  for (int64_t n = 0; n < N; n++) {
    CHECK(offsets[n] == place, "%lld begins at %lld", (long long)n, (long long)offsets[n]);
    for (int64_t i = 0; i < M; i++)
      if (index[i] == n) {
        CHECK(order[place] == i, "place %lld is %lld, not %lld", (long long)place, (long long)order[place],
              (long long)i);
        place++;
      }
  }
  CHECK(offsets[N] == M && place == M, "the end is %lld", (long long)offsets[N]);
  FREE(order, offsets, index);
}

static int64_t *new_index(int64_t M, int64_t N) {
  int64_t *index = new_ints(M);
  for (int64_t i = 0; i < M; i++) index[i] = (int64_t)(random_bits() % (uint64_t)N);
  return index;
}

static void test(const ast_kernels *kernels) {
  for (int64_t N = 1; N < 300; N = 3 * N + 1)
    for (int64_t M = 0; M < 2000; M = 2 * M + 1) check_sort(kernels, new_index(M, N), M, N);
  check_sort(kernels, new_index(0, 1), 0, 0);
}

int main(void) {
  on_every_table(test);
  return 0;
}
