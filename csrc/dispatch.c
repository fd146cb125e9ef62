/* Chooses the table of kernels by what the processor and the system support. */
#include <stddef.h>
#include <string.h>

#include "ast.h"

/* __builtin_cpu_supports also asks the operating system (XGETBV) whether it saves the wide registers. */
#define HAS        __builtin_cpu_supports
#define HAS_base   true
#define HAS_avx2   (HAS("avx2") && HAS("fma"))
#define HAS_avx512 (HAS("avx512f") && HAS("avx512bw") && HAS("avx512dq") && HAS("avx512vl") && HAS("fma"))

/* The instruction sets that were compiled, the best one first. */
#ifdef AST_HAVE_AVX512
#define IF_AVX512(set) set
#else
#define IF_AVX512(set)
#endif
#ifdef AST_HAVE_AVX2
#define IF_AVX2(set) set
#else
#define IF_AVX2(set)
#endif
#define SETS(SET) IF_AVX512(SET(avx512)) IF_AVX2(SET(avx2)) SET(base)

#define DECLARE(isa) extern const ast_kernels ast_kernels_##isa;
SETS(DECLARE)

const ast_kernels *ast_supported(int i) {
#define COUNT(isa) \
  if (HAS_##isa && i-- == 0) return &ast_kernels_##isa;
  SETS(COUNT)
  return NULL;
}

const ast_kernels *ast_select(const char *name) {
  if (!name) return ast_supported(0);
  const ast_kernels *table = NULL;
  for (int i = 0; (table = ast_supported(i)) && strcmp(table->isa, name) != 0; i++) {
  }
  return table;
}
