#define AST_ISA avx2
#include "kernels.c"
