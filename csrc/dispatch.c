/* Chooses the table of kernels by what the processor and the system support. */
#include <stddef.h>
#include <string.h>

#include "ast.h"

#if defined(AST_HAVE_AMX) && defined(__linux__)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

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

/* The same for products in bfloat16. */
#ifdef AST_HAVE_AMX
#define IF_AMX(set) set
#else
#define IF_AMX(set)
#endif
#ifdef AST_HAVE_AVX512_BF16
#define IF_AVX512_BF16(set) set
#else
#define IF_AVX512_BF16(set)
#endif
#define BFLOAT16_SETS(SET) IF_AMX(SET(amx)) IF_AVX512_BF16(SET(avx512_bf16))

#define DECLARE(isa) extern const ast_kernels ast_kernels_##isa;
SETS(DECLARE)
BFLOAT16_SETS(DECLARE)

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

/* Intel's processors do half as many operations a second by dot products of bfloat16 as in float32, AMD's twice as
 * many (docs/log.md). */
#define HAS_avx512_bf16 (HAS_avx512 && HAS("avx512bf16") && __builtin_cpu_is("amd"))
#define HAS_amx         (HAS_avx512 && HAS("avx512bf16") && dispatch_may_use_tiles())

#if defined(AST_HAVE_AMX) && defined(__linux__)
/* Tiles take 8 KB of state, so a process has to ask the kernel for them. */
static bool dispatch_may_use_tiles(void) {
  enum { REQUEST = 0x1023, TILE_DATA = 18, AMX_BF16 = 1 << 22, AMX_TILE = 1 << 24 };
  unsigned a, b, c, d;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(d & AMX_BF16) || !(d & AMX_TILE)) return false;
  return syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
}
#elif defined(AST_HAVE_AMX)
static bool dispatch_may_use_tiles(void) { return false; }
#endif

const ast_kernels *ast_bfloat16(int i) {
  (void)i;
#define COUNT_BFLOAT16(isa) \
  if (HAS_##isa && i-- == 0) return &ast_kernels_##isa;
  BFLOAT16_SETS(COUNT_BFLOAT16)
  return NULL;
}
