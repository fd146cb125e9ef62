/* All kernels of one instruction set as one translation unit: isa_*.c names the set and includes this file. Everything
 * is static, so that code for a newer processor can never be picked by the linker for an older one. */
#include "ast.h"
#include "simd.h"
#include "gemm.h"
#include "table.h"

#include "attention.c"
#include "attention_backward.c"
#include "counting_sort.c"
#include "breadth_first.c" /* after counting_sort.c */
#include "elastic_forces.c"
#include "elastic_stiffness.c"
#include "fps.c"
#include "linear.c"
#include "attention_block.c" /* after attention.c and linear.c, of which it is made */
#include "mesh.c"
#include "message.c"
#include "message_backward.c" /* after message.c, whose tiles it uses */
#include "mlp.c"
#include "octree.c"
#include "orthogonalize.c"
#include "coarsen.c"   /* after octree.c, whose chunks it uses */
#include "pairs.c"     /* after coarsen.c, whose levels it counts */
#include "proximity.c" /* after octree.c, whose sort it uses */
#include "segment.c"
#include "sparse_conv.c"
#include "sparse_conv_weight.c" /* after sparse_conv.c, whose constants it uses */

#define AST_ENTRY(name) .name = name,

const ast_kernels AST_TABLE(AST_ISA) = {
    .isa = AST_STRING(AST_ISA), .vector_bytes = AST_VECTOR_BYTES, AST_KERNELS(AST_ENTRY)};
