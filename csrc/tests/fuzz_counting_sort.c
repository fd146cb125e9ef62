/* Fuzzes counting_sort against its definition. */
#define main tests_of_counting_sort
#include "test_counting_sort.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t N = take_size(100), M = N ? take_size(300) : 0;
  check_state = take_word(2);
  int64_t *index = new_index(M, N + (N == 0));
  for (int edits = take_byte() % 8; edits-- > 0 && M > 0;) {
    const int64_t at = take_index(M);
    index[at] = take_index(N);
  }
  check_sort(kernels, index, M, N);
}
