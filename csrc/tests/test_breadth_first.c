/* breadth_first against its definition, with a search through all elements for the elements of a node. */
#include "problems.h"

typedef struct {
  int64_t E, K, N;
  const int64_t *elements, *wanted;
} mesh;

/* The nodes of a search, each of which is marked. */
static int64_t search_from(const mesh *m, int64_t start, bool *marked, int64_t *nodes) {
  int64_t num = 0;
  nodes[num++] = start, marked[start] = true;
  for (int64_t i = 0; i < num; i++)
    for (int64_t e = 0; e < m->E; e++) {
      bool has = false;
      for (int64_t k = 0; k < m->K; k++) has |= m->elements[e * m->K + k] == nodes[i];
      for (int64_t k = 0; has && k < m->K; k++) {
        const int64_t node = m->elements[e * m->K + k];
        if (!m->wanted[node] || marked[node]) continue;
        marked[node] = true, nodes[num++] = node;
      }
    }
  return num;
}

static void check_order(const ast_kernels *kernels, const mesh *m) {
  int64_t *rank = new_ints(m->N), *nodes = new_ints(m->N), done = 0;
  bool *marked = calloc((size_t)m->N + 1, sizeof *marked);
  CHECK(marked, "no memory");
  READ_ONLY(m->elements, m->wanted);
  CHECK(kernels->breadth_first(m->elements, m->E, m->K, m->wanted, m->N, rank) == AST_OK, "status");
  for (int64_t n = 0; n < m->N; n++) {
    if (!m->wanted[n]) CHECK(rank[n] == -1, "node %lld has the place %lld", (long long)n, (long long)rank[n]);
    if (!m->wanted[n] || marked[n]) continue;
    int64_t start = n, num = 0;
    for (int i = 0; i < 3; i++) {
      for (int64_t j = 0; j < num; j++) marked[nodes[j]] = false;
      num = search_from(m, start, marked, nodes);
      start = nodes[num - 1];
    }
    for (int64_t j = 0; j < num; j++, done++)
      CHECK(rank[nodes[j]] == done, "node %lld has the place %lld, not %lld", (long long)nodes[j],
            (long long)rank[nodes[j]], (long long)done);
  }
  free(marked);
  FREE(rank, nodes, m->elements, m->wanted);
}

static mesh new_mesh(int64_t E, int64_t K, int64_t N, uint64_t unwanted) {
  int64_t *elements = new_ints(E * K), *wanted = new_ints(N);
  for (int64_t i = 0; i < E * K; i++) elements[i] = (int64_t)(random_bits() % (uint64_t)N);
  for (int64_t n = 0; n < N; n++) wanted[n] = !unwanted || random_bits() % unwanted > 0;
  return (mesh){E, K, N, elements, wanted};
}

/* A row of tetrahedra, numbered at random: nodes of an element are in one level or the next, of three nodes each. */
static void test_row(const ast_kernels *kernels) {
  enum { E = 50, N = E + 3 };
  int64_t *elements = new_ints(4 * E), *wanted = new_ints(N), *rank = new_ints(N), number[N];
  for (int64_t n = 0; n < N; n++) {
    const int64_t other = (int64_t)(random_bits() % (uint64_t)(n + 1));
    wanted[n] = 1, number[n] = number[other], number[other] = n;
  }
  for (int64_t i = 0; i < 4 * E; i++) elements[i] = number[i / 4 + i % 4];
  CHECK(kernels->breadth_first(elements, E, 4, wanted, N, rank) == AST_OK, "status");
  for (int64_t i = 0; i < 4 * E; i++)
    CHECK(llabs(rank[elements[i]] - rank[elements[i / 4 * 4]]) <= 5, "the band is wide at %lld", (long long)i);
  FREE(elements, wanted, rank);
}

static void test(const ast_kernels *kernels) {
  static const int64_t sizes[] = {1, 2, 3, 7, 40, 150};
  for (int n = 0; n < 6; n++)
    for (int64_t K = 1; K < 5; K++)
      for (int64_t E = 0; E < 130; E = 2 * E + 1)
        for (uint64_t unwanted = 0; unwanted < 4; unwanted++) {
          const mesh m = new_mesh(E, K, sizes[n], unwanted);
          check_order(kernels, &m);
        }
  const mesh empty = new_mesh(0, 4, 0, 0);
  check_order(kernels, &empty);
  test_row(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
