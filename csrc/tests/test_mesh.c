/* mesh_edges and outer_faces against their definitions. */
#include "problems.h"

typedef struct {
  int64_t E, K, N, P, Q;
  int64_t *elements, *ends, *faces;
} mesh;

static mesh new_mesh(int64_t E, int64_t K, int64_t N, int64_t num_ends, int64_t num_faces) {
  const mesh m = {E, K, N, num_ends, num_faces, new_ints(E * K), new_ints(2 * num_ends), new_ints(3 * num_faces)};
  for (int64_t i = 0; i < E * K; i++) m.elements[i] = (int64_t)(random_bits() % (uint64_t)N);
  for (int64_t i = 0; i < 2 * m.P; i++) m.ends[i] = (int64_t)(random_bits() % (uint64_t)K);
  for (int64_t i = 0; i < 3 * m.Q; i++) m.faces[i] = (int64_t)(random_bits() % (uint64_t)K);
  return m;
}

static void check_edges(const ast_kernels *kernels, const mesh *m) {
  int64_t *senders = new_ints(2 * m->P * m->E), *receivers = new_ints(2 * m->P * m->E), *offsets = new_ints(m->N + 1);
  bool *joined = calloc((size_t)(m->N * m->N) + 1, sizeof *joined); /* [receiver, sender] */
  CHECK(joined, "no memory");
  for (int64_t e = 0; e < m->E; e++)
    for (int64_t p = 0; p < m->P; p++) {
      const int64_t a = m->elements[e * m->K + m->ends[2 * p]], b = m->elements[e * m->K + m->ends[2 * p + 1]];
      joined[a * m->N + b] = joined[b * m->N + a] = a != b;
    }
  CHECK(kernels->mesh_edges(m->elements, m->E, m->K, m->ends, m->P, m->N, senders, receivers, offsets) == AST_OK,
        "status");
  int64_t place = 0;
  for (int64_t i = 0; i < m->N * m->N; i++) {
    if (i % m->N == 0) CHECK(offsets[i / m->N] == place, "node %lld begins elsewhere", (long long)(i / m->N));
    if (!joined[i]) continue;
    CHECK(receivers[place] == i / m->N && senders[place] == i % m->N, "edge %lld is %lld to %lld", (long long)place,
          (long long)senders[place], (long long)receivers[place]);
    place++;
  }
  CHECK(offsets[m->N] == place, "there are %lld edges, not %lld", (long long)offsets[m->N], (long long)place);
  free(joined);
  FREE(senders, receivers, offsets);
}

/* The corners of a face, ascending. */
static void corners_of(const mesh *m, int64_t number, int64_t corners[3]) {
  for (int i = 0; i < 3; i++) corners[i] = m->elements[number / m->Q * m->K + m->faces[number % m->Q * 3 + i]];
  for (int i = 0; i < 2; i++)
    for (int j = 0; j < 2; j++)
      if (corners[j] > corners[j + 1]) {
        const int64_t larger = corners[j];
        corners[j] = corners[j + 1], corners[j + 1] = larger;
      }
}

static void check_faces(const ast_kernels *kernels, const mesh *m) {
  int64_t *outer = new_ints(m->E * m->Q), num = 0, place = 0;
  CHECK(kernels->outer_faces(m->elements, m->E, m->K, m->faces, m->Q, outer, &num) == AST_OK, "status");
  for (int64_t i = 0; i < m->E * m->Q; i++) {
    int64_t mine[3], others[3], like = 0;
    corners_of(m, i, mine);
    for (int64_t j = 0; j < m->E * m->Q; j++) {
      corners_of(m, j, others);
      like += !memcmp(mine, others, sizeof mine);
    }
    if (like > 1) continue;
    CHECK(place < num && outer[place] == i, "face %lld is left out", (long long)i);
    place++;
  }
  CHECK(place == num, "there are %lld outer faces, not %lld", (long long)num, (long long)place);
  FREE(outer);
}

static void check_mesh(const ast_kernels *kernels, const mesh *m) {
  READ_ONLY(m->elements, m->ends, m->faces);
  check_edges(kernels, m);
  check_faces(kernels, m);
  FREE(m->elements, m->ends, m->faces);
}

/* All elements share their first node: its rows are long. */
static void test_hub(const ast_kernels *kernels) {
  const mesh m = new_mesh(120, 4, 200, 6, 4);
  for (int64_t e = 0; e < m.E; e++) m.elements[4 * e] = 0;
  check_mesh(kernels, &m);
}

static void test(const ast_kernels *kernels) {
  for (int64_t N = 1; N < 100; N = 3 * N + 1)
    for (int64_t K = 1; K < 6; K++)
      for (int64_t E = 0; E < 130; E = 2 * E + 1) {
        const mesh m = new_mesh(E, K, N, K + 1, K);
        check_mesh(kernels, &m);
      }
  const mesh empty = new_mesh(0, 4, 1, 6, 4),
             nothing = {.K = 4, .elements = new_ints(0), .ends = new_ints(0), .faces = new_ints(0)};
  check_mesh(kernels, &empty);
  check_mesh(kernels, &nothing);
  test_hub(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
