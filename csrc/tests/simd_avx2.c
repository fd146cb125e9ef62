#define AST_ISA avx2
#include "simd_table.h"
