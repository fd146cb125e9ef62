#define AST_ISA base
#include "kernels.c"
