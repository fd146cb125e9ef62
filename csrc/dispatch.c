/* Chooses the table of kernels by what the processor and the system support. */
#include <stddef.h>
#include <string.h>

#include "ast.h"

extern const ast_kernels ast_kernels_base, ast_kernels_avx2, ast_kernels_avx512;

/* __builtin_cpu_supports also asks the operating system (XGETBV) whether it saves the wide registers. */
const ast_kernels *ast_select(const char *name) {
  const ast_kernels *tables[3];
  int num = 0;
#ifdef AST_HAVE_AVX512
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma"))
    tables[num++] = &ast_kernels_avx512;
#endif
#ifdef AST_HAVE_AVX2
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) tables[num++] = &ast_kernels_avx2;
#endif
  tables[num++] = &ast_kernels_base;
  if (!name) return tables[0];
  for (int i = 0; i < num; i++)
    if (!strcmp(tables[i]->isa, name)) return tables[i];
  return NULL;
}
