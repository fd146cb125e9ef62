/* Products in bfloat16 where there are no instructions for them. */
#define AST_ISA bfloat16_base
#include "../bfloat16_kernels.c"
