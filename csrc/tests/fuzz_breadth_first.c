/* Fuzzes breadth_first against its definition. */
#define main tests_of_breadth_first
#include "test_breadth_first.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t N = take_size(100), E = N ? take_size(100) : 0, K = 1 + take_byte() % 4;
  check_state = take_word(2);
  const mesh m = new_mesh(E, K, N, take_byte() % 5);
  for (int edits = take_byte() % 8; edits-- > 0 && E > 0;) {
    const int64_t at = take_index(E * K);
    ((int64_t *)m.elements)[at] = take_index(N);
  }
  check_order(kernels, &m);
}
