/* The public C interface of the ast_sim core: status codes, types and one contract per kernel.
 *
 * Nothing here knows Python, torch or OpenMP. Sizes and indices are int64_t. Float arrays are float32, row major and
 * contiguous unless a row stride is an argument. Ragged batches are concatenated; `offsets` [B+1] starts at 0, never
 * falls and ends at the number of rows. Inputs are never changed and outputs are written in full. The caller has
 * checked shapes, offsets and index ranges (module.c does it for Python); a kernel checks only what it alone can see,
 * such as a point outside the cube.
 *
 * Legend: B scenes, N nodes, C cells, T tokens, F channels, C_in and C_out channels of a convolution, D channels of a
 * head of attention, M rows of a dense layer (or edges, of S senders and R receivers), I and O its inputs and outputs.
 * H is the size of what lies between: the hidden units of two layers, the heads of attention. E elements, or channels
 * of an edge.
 */
#ifndef AST_H
#define AST_H

#include <stdbool.h>
#include <stdint.h>

typedef enum {
  AST_OK = 0,
  AST_NO_MEMORY,  /* scratch memory could not be had; outputs are undefined */
  AST_NOT_FINITE, /* octree: a position is NaN or infinite; elastic_stiffness: a stretch is lost */
  AST_OUTSIDE,    /* octree: a position lies outside the cube; farthest_point_sample: a scene is 2^21 or more wide */
  AST_TOO_LARGE,  /* octree_coarsen: more cells than an int32 can number */
} ast_status;

/* status.c: what it means, in words, for a message; never NULL. */
const char *ast_status_text(ast_status status);

/* The sizes of one attention: query rows of scene b attend to all key rows of scene b. */
typedef struct {
  int64_t B, H, D;
  const int64_t *q_offsets, *k_offsets; /* [B+1] */
  int64_t q_stride, k_stride, v_stride; /* floats from one row of q, k, v to the next, at least H*D */
  float scale;
  double dropout_p; /* weights are dropped with this probability, 0 <= p < 1 */
  uint64_t seed;    /* of the counter-based generator: key (seed), counter (scene, head, query, key) */
  int64_t dq_stride, dk_stride, dv_stride; /* the same of the gradients */
} ast_attention;

/* The pairs of a sparse convolution, grouped by kernel offset: group k is [offsets[k], offsets[k+1]) for k < 27.
 * Within a group `destination` rises strictly, so no two pairs of a group write the same row. */
typedef struct {
  const int64_t *offsets;              /* [28] */
  const int64_t *source, *destination; /* [offsets[27]] */
} ast_pairs;

/* One step of message passing over M edges from S senders to R receivers (message.c). Edges are sorted by receiver.
 * E = 0 and H = 0: nothing of the edges. E = F and H = 0: latents, without an encoder. H = 0 allows no other E. */
typedef struct {
  int64_t M, S, R;
  int64_t E, H, F, F2; /* channels: edge features, hidden layer of the encoder (0: none), first layer, messages */
  const int64_t *senders, *receivers, *receiver_offsets; /* [M], [M] ascending, [R+1] */
  const float *of_senders, *of_receivers;                /* [S,F], [R,F]: their products with the first layer */
  const float *edge_features;                            /* [M,E]: raw, or without an encoder such products, too */
  const float *A1, *a1, *A2;                             /* [H,E], [H], [F,H] */
  const float *W2, *b2, *gamma, *beta;                   /* [F2,F], [F2], [F2], [F2] */
} ast_message;

/* Its gradients, of the shapes of the inputs; edge_features may be NULL. */
typedef struct {
  float *of_senders, *of_receivers, *edge_features, *A1, *a1, *A2, *W2, *b2, *gamma, *beta;
} ast_message_gradients;
/* What follows the product of a linear layer: nothing, max(0, z), or a . gelu(b) for z = [a, b], a and b of half the
 * columns. */
typedef enum { AST_IDENTITY = 0, AST_RELU, AST_GEGLU } ast_activation;

/* The sizes of a linear layer on x [M,I] with weight [O,I]: z = x W^T + bias is [M,O], the output has O columns, or O/2
 * for GEGLU. */
typedef struct {
  int64_t M, I, O;
  int64_t x_stride, weight_stride, residual_stride, dout_stride; /* floats from row to row */
  ast_activation activation;
} ast_linear;

/* An attention block (attention_block.c): vectors x [Q,W] attend to a context [K,C] with H heads of D channels, and
 * have F hidden units. */
typedef struct {
  int64_t B, Q, K, W, C, H, D, F;
  const float *x, *context, *rotations, *context_rotations; /* [Q,W], [K,C]; [Q,D], [K,D] or NULL: cosines and sines */
  const int64_t *q_offsets, *k_offsets;                     /* [B+1] */
  const float *gamma, *beta, *context_gamma, *context_beta; /* [W], [W], [C], [C] */
  const float *query, *key_value, *weight, *bias;           /* [H*D,W], [2*H*D,C], [W,H*D], [W] */
  const float *inner_gamma, *inner_beta;                    /* [W] */
  const float *first, *first_bias, *second, *second_bias;   /* [2F,W], [2F], [W,F], [W] */
} ast_attention_block;

/* What the block's forward pass keeps for its gradients, each NULL if it is not kept: rotated queries [Q,H*D], rotated
 * keys and values [K,2*H*D], what attention makes of them [Q,H*D] with its maximum and sum [Q,H], y [Q,W], what enters
 * GEGLU [Q,2F] and the hidden units [Q,F]. */
typedef struct {
  float *queries, *keys_values, *mixed, *maximum, *total, *y, *z, *hidden;
} ast_attention_block_kept;

/* Gradients of the shapes of the inputs, each NULL if it is not wanted. */
typedef struct {
  float *x, *context, *gamma, *beta, *context_gamma, *context_beta, *query, *key_value, *weight, *bias, *inner_gamma,
      *inner_beta, *first, *first_bias, *second, *second_bias;
} ast_attention_block_gradients;

/* Two dense layers: h = max(0, [x, beside] weight1^T + bias1), y = h weight2^T + bias2, then LayerNorm if there is a
 * gamma. */
typedef struct {
  int64_t M, I, I2, H, O;                                        /* beside [M,I2] may be NULL, with I2 = 0 */
  int64_t x_stride, beside_stride, residual_stride, dout_stride; /* floats from row to row */
  const float *x, *beside;
  const float *weight1, *bias1, *weight2, *bias2; /* [H,I+I2], [H], [O,H], [O]; a bias may be NULL */
  const float *gamma, *beta;                      /* [O], both or none NULL */
} ast_mlp;

/* What the forward pass may keep for the backward pass: h [M,H], y normalized [M,O] and its factors [M], each NULL if
 * it is not. */
typedef struct {
  float *hidden, *normalized, *scale;
} ast_mlp_kept;

/* Gradients, each NULL if it is not wanted. */
typedef struct {
  float *x, *beside, *weight1, *bias1, *weight2, *bias2, *gamma, *beta;
} ast_mlp_gradients;
/* Tetrahedra of a St. Venant-Kirchhoff material. node_order holds the numbers 4 e + corner, by the node at that corner,
 * then ascending. */
typedef struct {
  int64_t N, E;                                        /* nodes, elements */
  const int64_t *elements, *node_order, *node_offsets; /* [E,4], [4E], [N+1]: the corners at node n */
  const float *position, *rest_position;               /* [N,3] */
  const float *lame;                                   /* [E,2]: lambda and mu */
} ast_elastic;

/* Elastic tetrahedra and what is known at their points, in double; elastic_stiffness.c has the formulas. */
typedef struct {
  int64_t E, Q, K;                        /* elements; points and nodes of each: 1 and 4, or 4 and 10 */
  const double *F, *gradients;            /* [3,3,Q,E], [K,3,Q,E] of the shape functions */
  const double *volume, *mu, *c, *spread; /* [Q,E] */
  bool project;                           /* negative eigenvalues by F become zero */
} ast_stiffness;

/* Surfaces of bodies: triangles whose nodes belong to the body of the first, counter-clockwise seen from outside. */
typedef struct {
  int64_t B, N, F;                          /* scenes, nodes, triangles */
  const float *position, *motion;           /* [N,3]; their sum counts, and is finite */
  const int64_t *offsets, *surface_offsets; /* [B+1], of nodes and of triangles */
  const int64_t *body, *surface;            /* [N], [F,3] */
  double radius;                            /* positive and finite */
} ast_proximity;

/* A level of an octree and how it follows from the next finer one. It lies in scratch memory of the calling thread: the
 * caller of octree_coarsen sets a mark before, and releases it when the levels are written out. */
typedef struct {
  int64_t C, C_fine, B;    /* cells of this level and of the finer one, scenes */
  int64_t *keys, *offsets; /* [C], [B+1] as in octree_build */
  int64_t *families;       /* [C+1]: first child << 8 | set of the octants 4x+2y+z of all children */
  uint8_t *near;           /* [C]: whether the scene has a cell at P - (i,j,k) for any (i,j,k) of 0 and 1 but (0,0,0) */
  int32_t (*before)[8];    /* [C,8]: where it has, these cells by 4i+2j+k, or -1 */
  uint64_t *others; /* [C]: the fine cells that pair with P and are no children of it, as bits 8 (4i+2j+k) + octant */
  int64_t *pairs;   /* where the pairs of each chunk go; of octree_write_level alone */
  int64_t pair_offsets[28]; /* of the pairs with the finer level, by kernel offset */
} ast_octree_level;

/* One table per instruction set; every entry has the same contract on each. */
typedef struct {
  const char *isa;
  int vector_bytes;

  /* out[c] = sum (or mean) of x[node_order[j]] for node_offsets[c] <= j < node_offsets[c+1], in that order by chains of
   * 256 rows, whose sums are added by halves; 0 if empty. x [N,F], node_order [node_offsets[C]], out [C,F]. */
  ast_status (*segment_sum)(const float *restrict x, int64_t F, const int64_t *restrict node_order,
                            const int64_t *restrict node_offsets, int64_t C, bool mean, float *restrict out);
  /* The adjoint: dx[node_order[j]] = dout[c] (over the number of rows of c if mean). node_order is a permutation of
   * 0..N-1. */
  ast_status (*segment_spread)(const float *restrict dout, int64_t F, const int64_t *restrict node_order,
                               const int64_t *restrict node_offsets, int64_t C, bool mean, float *restrict dx);

  /* The cells that hold points, of a cube that is cut into 2^depth parts per axis.
   *   positions [N,3], offsets [B+1]; center, half_width: the cube center +- half_width; 0 <= depth <= 21
   *   keys: of the cells, ascending within a scene; Morton, x the most significant axis; room for N
   *   cell_offsets [B+1]: the cells of each scene; C = cell_offsets[B] of all
   *   node_cell [N]: the cell of each point
   *   node_order [N]: the points by scene, key and number
   *   node_offsets: [C+1] places in node_order of the points of each cell; room for N + 1
   *   *bad_node: on AST_NOT_FINITE and AST_OUTSIDE (beyond 1e-6 of the width of the cube) the first such point
   * Index per axis: floor((p - center + half_width) / (2 half_width) * 2^depth) in double, clamped to
   * [0, 2^depth - 1]. */
  ast_status (*octree_build)(const float *restrict positions, const int64_t *restrict offsets, int64_t B,
                             const double center[3], double half_width, int depth, int64_t *restrict keys,
                             int64_t *restrict cell_offsets, int64_t *restrict node_cell, int64_t *restrict node_order,
                             int64_t *restrict node_offsets, int64_t *bad_node);
  /* coordinates [C,3]: x, y and z of each cell, 0..2^21 - 1. */
  ast_status (*octree_coordinates)(const int64_t *restrict keys, int64_t C, int32_t *restrict coordinates);
  /* The next `levels` <= 21 coarser levels of cells keys [C] (ascending within a scene), finest first, and the number
   * of pairs (fine, coarse) with fine = 2 P + (a,b,c) of each, grouped by kernel offset 9(a+1) + 3(b+1) + (c+1). */
  ast_status (*octree_coarsen)(const int64_t *restrict keys, const int64_t *restrict offsets, int64_t B, int levels,
                               ast_octree_level *restrict level);
  /* Writes a level out.
   *   keys [C], offsets [B+1]: as in octree_build
   *   first_child [C+1]: the finer cells first_child[c] <= j < first_child[c+1] are the children of c
   *   node_cell [C_fine]: the parent of each finer cell
   *   fine, coarse [pair_offsets[27]]: the pairs, coarse rising within each group
   *   fine_by_fine, coarse_by_fine: the same pairs, fine rising within each group */
  ast_status (*octree_write_level)(const ast_octree_level *level, int64_t *restrict keys, int64_t *restrict offsets,
                                   int64_t *restrict first_child, int64_t *restrict node_cell, int64_t *restrict fine,
                                   int64_t *restrict coarse, int64_t *restrict fine_by_fine,
                                   int64_t *restrict coarse_by_fine);

  /* Exact greedy farthest point sampling of coordinates [C,3], per scene min(num, C_b) indices (into the
   * whole array) from out_offsets[b] on: the first is the scene's first point, ties go to the lowest index, and once
   * all distances are 0 the lowest unused index follows. A scene with at most `num` points gives all of them,
   * ascending. AST_OUTSIDE if two coordinates of a scene differ by 2^21 or more. */
  ast_status (*farthest_point_sample)(const int32_t *restrict coordinates, const int64_t *restrict offsets, int64_t B,
                                      int64_t num, const int64_t *restrict out_offsets, int64_t *restrict indices);

  /* out = bias, then out[destination] += x[source] W_k over all pairs of group k, groups in ascending order. weight
   * [27,C_in,C_out]; with `transposed` weight [27,C_out,C_in] is used as W_k^T. x [*,C_in], bias [C_out] or NULL for 0,
   * out [num_out,C_out]. */
  ast_status (*sparse_conv)(const float *restrict x, const float *restrict weight, const float *restrict bias,
                            int64_t C_in, int64_t C_out, bool transposed, ast_pairs pairs, int64_t num_out,
                            float *restrict out);
  /* dweight[k] = sum over the pairs of group k of x[source]^T dout[destination]. dweight [27,C_in,C_out]. */
  ast_status (*sparse_conv_weight)(const float *restrict x, const float *restrict dout, int64_t C_in, int64_t C_out,
                                   ast_pairs pairs, float *restrict dweight);

  /* Attention of the scores x = scale q[q,h] . k[k,h].
   *   q [Tq,H,D], k and v [Tk,H,D]: rows at the strides of s; D is a multiple of 16, at most 128
   *   out [Tq,H,D], contiguous: out[q,h] = sum_k P[q,h,k] v[k,h], P = dropout(softmax_k(x))
   *   maximum, sum [Tq,H]: max_k x and sum_k exp(x - maximum), so that log sum exp is maximum + log(sum)
   * Without keys: out 0, maximum -inf, sum 0. A row with a NaN or +inf score, or with only -inf, is NaN in all
   * outputs. */
  ast_status (*attention)(const ast_attention *s, const float *restrict q, const float *restrict k,
                          const float *restrict v, float *restrict out, float *restrict maximum, float *restrict sum);
  /* Its gradients, P recomputed from maximum and sum. dq [Tq,H,D], dk and dv [Tk,H,D]. */
  ast_status (*attention_backward)(const ast_attention *s, const float *restrict q, const float *restrict k,
                                   const float *restrict v, const float *restrict out, const float *restrict maximum,
                                   const float *restrict sum, const float *restrict dout, float *restrict dq,
                                   float *restrict dk, float *restrict dv);

  /* The block's vectors, out [Q,W], without dropout. D is a multiple of 16 up to 128. */
  ast_status (*attention_block)(const ast_attention_block *s, float *restrict out, ast_attention_block_kept kept);
  /* Its gradients, dout [Q,W]. z is computed again if it was not kept; everything else is kept. Rotations have none. */
  ast_status (*attention_block_backward)(const ast_attention_block *s, const float *restrict dout,
                                         ast_attention_block_kept kept, ast_attention_block_gradients g);

  /* sum[r] = sum over the edges m into r, in stored order by chains of 256, of
   * messages[m] = LN(W2 relu(z_m) + b2; gamma, beta), where
   * z_m = of_senders[s] + of_receivers[r] + A2 relu(A1 e_m + a1), or + e_m without an encoder; 0 without edges.
   * sum [R,F2]; messages [M,F2] or NULL. */
  ast_status (*message)(const ast_message *s, float *restrict sum, float *restrict messages);
  /* Its gradients, layers recomputed. dsum [R,F2], dmessages [M,F2] or NULL. */
  ast_status (*message_backward)(const ast_message *s, const float *restrict dsum, const float *restrict dmessages,
                                 const ast_message_gradients *out);
  /* out = act(z) + residual with z = x W^T + bias; bias [O] and residual may be NULL, and so z [M,O], if it is not
   * wanted. */
  ast_status (*linear)(const ast_linear *s, const float *restrict x, const float *restrict weight,
                       const float *restrict bias, const float *restrict residual, float *restrict out,
                       float *restrict z);
  /* Its gradients dx [M,I], dweight [O,I] and dbias [O], each NULL if it is not wanted. z is recomputed if it is NULL;
   * for ReLU max(0, z) will do. */
  ast_status (*linear_backward)(const ast_linear *s, const float *restrict dout, const float *restrict x,
                                const float *restrict weight, const float *restrict bias, const float *restrict z,
                                float *restrict dx, float *restrict dweight, float *restrict dbias);
  /* force [N,3] = -dE/dposition of the energy E = sum_e V (lambda/2 tr(G)^2 + mu G:G), G = (F^T F - I) / 2, added at
   * each node in the order of node_order, by chains of 256 whose sums are added by halves. An element contributes
   * exactly nothing, whatever its positions, if its Lame constants are both 0, a rest position is not finite, or its
   * rest volume is no more than rounding. */
  ast_status (*elastic_forces)(const ast_elastic *s, float *restrict force);
  /* dposition [N,3] = (dforce/dposition) dforce, whose matrix is symmetric: the gradient. */
  ast_status (*elastic_forces_backward)(const ast_elastic *s, const float *restrict dforce, float *restrict dposition);
  /* entries [3K (3K+1) / 2,E]: the second derivative of each element's energy by its positions, row by row of the upper
   * triangle; row 3 a + i is component i of node a. AST_NOT_FINITE if a projected point is so flat that its stretch is
   * lost in rounding, or if its numbers are not finite; entries are undefined then. */
  ast_status (*elastic_stiffness)(const ast_stiffness *s, double *restrict entries);
  /* out [N,5]: the outward normal at the nearest point of another body of the scene, times 1 - |gap| / radius; then
   * gap / radius and gap / (0.1 radius), clipped to -1..1. The gap is negative inside the body. 0, 0, 0, 1, 1 if none
   * is nearer than the radius. Triangles without an area do not count. */
  ast_status (*proximity)(const ast_proximity *s, float *restrict out);
  /* rank[n] = the place of a wanted node in an order in which the nodes of each of the elements [E,K] are near each
   * other, or -1 (breadth_first.c). wanted and rank [N]. */
  ast_status (*breadth_first)(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict wanted,
                              int64_t N, int64_t *restrict rank);
  /* order [M]: the places of an index [M] of numbers below N, by number, then ascending. The number n stands at
   * order[offsets[n]:offsets[n+1]]; offsets [N+1]. */
  ast_status (*counting_sort)(const int64_t *restrict index, int64_t M, int64_t N, int64_t *restrict order,
                              int64_t *restrict offsets);
  /* The edges of the elements [E,K], in both directions and each once, by receiver, then by sender. ends [P,2] are the
   * local edges of an element. offsets [N+1] say where the edges into each node stand in senders and receivers, which
   * have room for 2 P E. */
  ast_status (*mesh_edges)(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict ends,
                           int64_t P, int64_t N, int64_t *restrict senders, int64_t *restrict receivers,
                           int64_t *restrict offsets);
  /* The numbers e Q + q, ascending, of the faces whose corners no other face has: face q of element e has the corners
   * elements[e, faces[q]]; faces [Q,3]. outer has room for E Q; *num are found. */
  ast_status (*outer_faces)(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict faces,
                            int64_t Q, int64_t *restrict outer, int64_t *num);
  /* out[f] = sum of x[n,f] over n, rows in blocks whose sums are added by halves: the gradient of a bias. x [N,F], out
   * [F]. */
  ast_status (*column_sum)(const float *restrict x, int64_t N, int64_t F, float *restrict out);
  /* out[k] = U V^T, about, where x[k] = U S V^T: five iterations of Muon. Singular values below 0.002 of the norm stay
   * smaller; of a norm below 1e-37 they do, too. x and out [K,R,C]. */
  ast_status (*orthogonalize)(const float *restrict x, int64_t K, int64_t R, int64_t C, float *restrict out);
  /* out [M,O] = y, or LayerNorm(y), + residual, which may be NULL. */
  ast_status (*mlp)(const ast_mlp *s, const float *restrict residual, float *restrict out, ast_mlp_kept kept);
  /* Its gradients; what was not kept is computed again. */
  ast_status (*mlp_backward)(const ast_mlp *s, const float *restrict dout, ast_mlp_kept kept,
                             ast_mlp_gradients gradients);
} ast_kernels;

/* Every kernel of the table. */
#define AST_KERNELS(KERNEL)        \
  KERNEL(segment_sum)              \
  KERNEL(segment_spread)           \
  KERNEL(octree_build)             \
  KERNEL(octree_coordinates)       \
  KERNEL(octree_coarsen)           \
  KERNEL(octree_write_level)       \
  KERNEL(farthest_point_sample)    \
  KERNEL(sparse_conv)              \
  KERNEL(sparse_conv_weight)       \
  KERNEL(attention)                \
  KERNEL(attention_backward)       \
  KERNEL(attention_block)          \
  KERNEL(attention_block_backward) \
  KERNEL(message)                  \
  KERNEL(message_backward)         \
  KERNEL(linear)                   \
  KERNEL(linear_backward)          \
  KERNEL(elastic_forces)           \
  KERNEL(elastic_forces_backward)  \
  KERNEL(elastic_stiffness)        \
  KERNEL(proximity)                \
  KERNEL(breadth_first)            \
  KERNEL(counting_sort)            \
  KERNEL(mesh_edges)               \
  KERNEL(outer_faces)              \
  KERNEL(column_sum)               \
  KERNEL(orthogonalize)            \
  KERNEL(mlp)                      \
  KERNEL(mlp_backward)

/* dispatch.c: the table of an instruction set by name ("base", "avx2", "avx512"), or of the best one if name is NULL.
 * NULL if it was not compiled in or the processor and system do not support it. */
const ast_kernels *ast_select(const char *name);
/* The table of the i-th of the instruction sets that are supported, the best one first; NULL beyond the last. */
const ast_kernels *ast_supported(int i);
/* The same of the instruction sets that multiply in bfloat16 faster than others in float32. A table has attention,
 * the sparse convolution and the kernels that are made of dense layers, whose products round both factors to bfloat16
 * (bfloat16.h); the others are NULL. */
const ast_kernels *ast_bfloat16(int i);

/* parallel.c: runs task(i, context) for 0 <= i < tasks, on the threads of the pool if one was set, and returns the
 * first status by index that is not AST_OK. Tasks are handed out dynamically: a task must depend on its index alone. */
typedef ast_status (*ast_task)(int64_t index, void *context);
ast_status ast_parallel(int64_t tasks, ast_task task, void *context);
/* The pool: torch's own (torch_parallel_for, torch_get_num_threads), handed over as pointers; NULL means serial. */
typedef int32_t (*ast_parallel_for)(int64_t begin, int64_t end, int64_t grain, void (*body)(int64_t, int64_t, void *),
                                    void *context);
typedef int32_t (*ast_num_threads)(uint32_t *num);
void ast_set_pool(ast_parallel_for parallel_for, ast_num_threads num_threads);
int64_t ast_threads(void);

/* memory.c: scratch memory of the calling thread, 64-byte aligned, kept between calls; NULL if memory is out. It is
 * good until a mark from before it is released: marks nest. ast_parallel releases what a task took. */
void *ast_scratch(int64_t bytes);
void *ast_scratch_mark(void);
void ast_scratch_release(void *mark);
/* What a block of C takes from here on is released where the block is left. */
#define AST_SCRATCH_SCOPE          AST_SCRATCH_SCOPE_AT(__LINE__)
#define AST_SCRATCH_SCOPE_AT(line) AST_SCRATCH_SCOPE_OF(line)
#define AST_SCRATCH_SCOPE_OF(line) \
  __attribute__((cleanup(ast_scratch_leave), unused)) void *const scratch_mark_##line = ast_scratch_mark()
static inline void ast_scratch_leave(void *const *mark) { ast_scratch_release(*mark); }
/* Lets the C library keep large freed blocks (glibc): fresh pages cost more than the arithmetic. True if it had an
 * effect. */
bool ast_keep_memory(void);

#endif
