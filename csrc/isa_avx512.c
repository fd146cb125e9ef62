#define AST_ISA avx512
#include "kernels.c"
