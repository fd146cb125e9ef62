/* Fuzzes elastic_forces and its gradient: any numbers and any corners. Elements in another order, each alone at its
 * nodes, give the same bits; without stiffness they give exactly nothing. */
#include "fuzz.h"

/* The corners by node, ascending. */
static void sort_corners(ast_elastic *s) {
  int64_t *order = new_ints(4 * s->E), *offsets = new_ints(s->N + 1), used = 0;
  for (int64_t n = 0; n < s->N; n++) {
    offsets[n] = used;
    for (int64_t k = 0; k < 4 * s->E; k++)
      if (s->elements[k] == n) order[used++] = k;
  }
  offsets[s->N] = used;
  s->node_order = order, s->node_offsets = offsets;
}

/* Forces and changes [4E,3] at corners that have a node each. */
static void scatter(const ast_kernels *kernels, const ast_elastic *s, const float *direction, float *force,
                    float *change) {
  ast_elastic apart = {.N = 4 * s->E, .E = s->E, .lame = s->lame};
  int64_t *elements = new_ints(4 * s->E);
  float *of[3];
  const float *from[3] = {s->position, s->rest_position, direction};
  for (int which = 0; which < 3; which++) {
    of[which] = new_floats(12 * s->E);
    for (int64_t k = 0; k < 12 * s->E; k++) of[which][k] = from[which][3 * s->elements[k / 3] + k % 3];
  }
  for (int64_t k = 0; k < 4 * s->E; k++) elements[k] = k;
  apart.elements = elements, apart.position = of[0], apart.rest_position = of[1];
  sort_corners(&apart);
  CHECK(kernels->elastic_forces(&apart, force) == AST_OK, "status");
  CHECK(kernels->elastic_forces_backward(&apart, of[2], change) == AST_OK, "status");
  FREE(elements, of[0], of[1], of[2], apart.node_order, apart.node_offsets);
}

static void fuzz(const ast_kernels *kernels) {
  ast_elastic s = {.N = take_size(60)};
  s.E = s.N ? take_size(70) : 0;
  int64_t *elements = new_ints(4 * s.E);
  check_state = take_word(2);
  for (int64_t k = 0; k < 4 * s.E; k++) elements[k] = (int64_t)(random_bits() % (uint64_t)s.N);
  s.elements = elements;
  sort_corners(&s);
  const bool stiff = take_byte() % 4;
  float *lame = take_floats(2 * s.E), *direction = take_floats(3 * s.N);
  for (int64_t i = 0; !stiff && i < 2 * s.E; i++) lame[i] = 0;
  s.lame = lame, s.position = take_floats(3 * s.N), s.rest_position = take_floats(3 * s.N);
  float *force = new_floats(3 * s.N), *change = new_floats(3 * s.N), *at_corners = new_floats(12 * s.E),
        *changes = new_floats(12 * s.E);
  READ_ONLY(s.elements, s.node_order, s.node_offsets, s.lame, s.position, s.rest_position, direction);
  CHECK(kernels->elastic_forces(&s, force) == AST_OK, "status");
  CHECK(kernels->elastic_forces_backward(&s, direction, change) == AST_OK, "status");
  scatter(kernels, &s, direction, at_corners, changes);
  for (int64_t i = 0; i < 3 * s.N; i++) {
    float sum = 0, sum_of_changes = 0;
    for (int64_t j = s.node_offsets[i / 3]; j < s.node_offsets[i / 3 + 1]; j++) {
      sum += at_corners[3 * s.node_order[j] + i % 3];
      sum_of_changes += changes[3 * s.node_order[j] + i % 3];
    }
    CHECK(same_floats(&sum, force + i, 1), "force %lld is %g, not %g", (long long)i, (double)force[i], (double)sum);
    CHECK(same_floats(&sum_of_changes, change + i, 1), "change %lld is %g", (long long)i, (double)change[i]);
    CHECK(stiff || (force[i] == 0 && change[i] == 0), "without stiffness %lld is %g", (long long)i, (double)force[i]);
  }
  FREE(s.elements, s.node_order, s.node_offsets, s.lame, s.position, s.rest_position, direction, force, change,
       at_corners, changes);
}
