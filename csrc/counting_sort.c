/* The places of each value of an index: a stable sort of small numbers, in time and memory proportional to their
 * count. */
#include "ast.h"
#include "simd.h"

static ast_status counting_sort(const int64_t *restrict index, int64_t M, int64_t N, int64_t *restrict order,
                                int64_t *restrict offsets) {
  memset(offsets, 0, (size_t)(N + 1) * sizeof *offsets);
  for (int64_t i = 0; i < M; i++) offsets[index[i]]++;
  for (int64_t n = 0; n < N; n++) offsets[n + 1] += offsets[n]; /* the end of each value, */
  for (int64_t i = M; i-- > 0;) order[--offsets[index[i]]] = i; /* which goes down to its beginning */
  return AST_OK;
}
