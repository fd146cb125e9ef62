#define AST_ISA base
#include "simd_table.h"
