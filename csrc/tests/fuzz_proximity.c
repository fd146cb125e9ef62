/* Fuzzes proximity against all triangles: any triangles, bodies and finite positions. */
#define main tests_of_proximity
#include "test_proximity.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  static const double radii[] = {0.1, 0.5, 1, 3, 1e-30, 1e30, 1e-300, 1e300};
  const int64_t B = take_size(3);
  int64_t *offsets = take_offsets(B, 60), *surface_offsets = new_ints(B + 1), N = offsets[B];
  surface_offsets[0] = 0;
  for (int64_t b = 0; b < B; b++)
    surface_offsets[b + 1] = surface_offsets[b] + (offsets[b + 1] > offsets[b] ? take_size(100) : 0);
  const int64_t F = surface_offsets[B], bodies = 1 + take_byte() % 4;
  int64_t *body = new_ints(N), *surface = new_ints(3 * F);
  check_state = take_word(2);
  for (int64_t i = 0; i < N; i++) body[i] = (int64_t)(random_bits() % (uint64_t)bodies) - 1;
  for (int64_t b = 0; b < B; b++)
    for (int64_t i = 3 * surface_offsets[b]; i < 3 * surface_offsets[b + 1]; i++)
      surface[i] = offsets[b] + (int64_t)(random_bits() % (uint64_t)(offsets[b + 1] - offsets[b]));
  float *position = take_floats(3 * N), *motion = take_floats(3 * N);
  const int cells = take_byte() % 8; /* a coarse grid makes points coincide */
  for (int64_t i = 0; i < 3 * N; i++) {
    if (!isfinite(position[i])) position[i] = 1;
    if (!isfinite(motion[i])) motion[i] = 0;
    if (cells) position[i] = roundf(position[i] * (float)cells) / (float)cells, motion[i] = 0;
    if (!isfinite(position[i])) position[i] = 2;
  }
  const ast_proximity s = {B, N, F, position, motion, offsets, surface_offsets, body, surface, radii[take_byte() % 8]};
  check_proximity(kernels, &s, "fuzzed");
  FREE(PROXIMITY_BUFFERS(&s));
}
