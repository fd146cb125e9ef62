#define AST_ISA avx512_bf16
#include "bfloat16_kernels.c"
