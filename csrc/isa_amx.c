#define AST_ISA amx
#include "bfloat16_kernels.c"
