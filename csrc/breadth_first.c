/* An order of nodes in which the nodes of each element are near each other: a matrix with an entry for each pair of
 * nodes of an element then has a narrow band.
 *
 * Nodes are taken breadth first: after a node come the new nodes of its elements, element by element. A search starts
 * at the lowest node that is left; from where it ends, which is far away, another search starts, and from its end the
 * last one. (Cuthill and McKee 1969 also take neighbours with few neighbours first; it makes the band no narrower on
 * meshes of tetrahedra.)
 */
#include "ast.h"
#include "simd.h"

enum { BREADTH_FIRST_SEARCHES = 3 };

typedef struct {
  const int64_t *elements, *offsets, *at_node; /* [E,K], [N+1], [E K]: the elements at node n, ascending */
  int64_t K;
  int64_t *seen; /* [N]: the last search that came here; INT64_MAX at nodes that are not wanted */
} breadth_first_mesh;

/* Writes the nodes of the search from `start` to `reached`; their number. Searches are counted from 1 on. */
static int64_t breadth_first_search(const breadth_first_mesh *m, int64_t start, int64_t search, int64_t *reached) {
  int64_t num = 0;
  reached[num++] = start;
  m->seen[start] = search;
  for (int64_t i = 0; i < num; i++)
    for (int64_t j = m->offsets[reached[i]]; j < m->offsets[reached[i] + 1]; j++)
      for (int64_t k = 0; k < m->K; k++) {
        const int64_t node = m->elements[m->at_node[j] * m->K + k];
        if (m->seen[node] >= search) continue;
        m->seen[node] = search;
        reached[num++] = node;
      }
  return num;
}

static ast_status breadth_first(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict wanted,
                                int64_t N, int64_t *restrict rank) {
  AST_SCRATCH_SCOPE;
  const int64_t word = (int64_t)sizeof(int64_t);
  int64_t *offsets = ast_scratch((N + 1) * word), *at_node = ast_scratch(E * K * word);
  int64_t *seen = ast_scratch(N * word), *reached = ast_scratch(N * word);
  if (!offsets || !at_node || !seen || !reached) return AST_NO_MEMORY;
  counting_sort(elements, E * K, N, at_node, offsets);
  for (int64_t i = 0; i < E * K; i++) at_node[i] /= K;
  for (int64_t n = 0; n < N; n++) seen[n] = wanted[n] ? 0 : INT64_MAX, rank[n] = -1;
  const breadth_first_mesh mesh = {elements, offsets, at_node, K, seen};
  int64_t search = 0, num = 0;
  for (int64_t n = 0; n < N; n++) {
    if (!wanted[n] || rank[n] >= 0) continue;
    int64_t start = n, size = 0;
    for (int i = 0; i < BREADTH_FIRST_SEARCHES; i++) {
      size = breadth_first_search(&mesh, start, ++search, reached);
      start = reached[size - 1];
    }
    for (int64_t i = 0; i < size; i++) rank[reached[i]] = num++;
  }
  return AST_OK;
}
