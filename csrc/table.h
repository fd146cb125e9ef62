/* The name of the table of kernels that a translation unit fills; AST_ISA is its instruction set. */
#ifndef AST_TABLE_H
#define AST_TABLE_H

#include "ast.h"

#define AST_TABLE_OF(isa)  ast_kernels_##isa
#define AST_TABLE(isa)     AST_TABLE_OF(isa)
#define AST_STRING_OF(isa) #isa
#define AST_STRING(isa)    AST_STRING_OF(isa)

extern const ast_kernels AST_TABLE(AST_ISA);

#endif
