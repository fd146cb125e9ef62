/* Attention, the sparse convolution and the kernels that are made of dense layers, with products in bfloat16: the
 * others of the table are NULL. isa_amx.c and isa_avx512_bf16.c name the set of instructions and include this file. */
#define AST_BFLOAT16
#include "table.h"

#include "attention.c"
#include "attention_backward.c"
#include "linear.c"
#include "attention_block.c" /* after attention.c and linear.c, of which it is made */
#include "message.c"
#include "message_backward.c" /* after message.c, whose tiles it uses */
#include "mlp.c"
#include "sparse_conv.c"

const ast_kernels AST_TABLE(AST_ISA) = {.isa = AST_STRING(AST_ISA),
                                        .vector_bytes = AST_VECTOR_BYTES,
                                        .attention = attention,
                                        .attention_backward = attention_backward,
                                        .attention_block = attention_block,
                                        .attention_block_backward = attention_block_backward,
                                        .linear = linear,
                                        .linear_backward = linear_backward,
                                        .message = message,
                                        .message_backward = message_backward,
                                        .mlp = mlp,
                                        .mlp_backward = mlp_backward,
                                        .sparse_conv = sparse_conv};
