/* Fuzzes elastic_stiffness against its definition; with edited numbers, only that it returns. */
#define main tests_of_elastic_stiffness
#include "test_elastic_stiffness.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t K = take_byte() % 2 ? 4 : 10, E = take_size(60);
  const bool project = take_byte() % 2;
  check_state = take_word(2);
  const ast_stiffness s = new_elements(E, K, project);
  int edits = take_byte() % 4;
  if (!edits || !E) check_elements(kernels, &s);
  else {
    double *entries = new_doubles(3 * K * (3 * K + 1) / 2 * E);
    while (edits-- > 0) ((double *)s.F)[take_index(9 * s.Q * E)] = (double)take_float();
    run(kernels, &s, entries);
    FREE(entries);
  }
  free_elements(&s);
}
