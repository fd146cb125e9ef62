#define AST_ISA avx512
#include "simd_table.h"
