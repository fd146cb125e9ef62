/* Fuzzes mesh_edges and outer_faces against their definitions. */
#define main tests_of_mesh
#include "test_mesh.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t N = 1 + take_size(60), E = take_size(60), K = 1 + take_byte() % 10;
  const int64_t ends = take_byte() % 8, faces = take_byte() % 5;
  check_state = take_word(2);
  const mesh m = new_mesh(E, K, N, ends, faces);
  for (int edits = take_byte() % 8; edits-- > 0 && E > 0;) {
    const int64_t at = take_index(E * K);
    m.elements[at] = take_index(N);
  }
  check_mesh(kernels, &m);
}
