/* How each kernel is called with the arguments that its spec in ast_sim/ops has taken apart. Included by module.c
 * alone.
 *
 * KERNEL(name, parameters...) { body } names the parameters in the order of the spec, which is compared with them at
 * import. In the body `a` are the arguments by name, `n` the sizes by letter of the spec, and `result` is what takes
 * more than a status.
 */
#ifndef AST_MODULE_KERNELS_H
#define AST_MODULE_KERNELS_H

#include <math.h>

#include "arguments.h"

#define NAMES_OF(...) #__VA_ARGS__
#define PARAMETERS(name, ...)                                                                              \
  typedef struct {                                                                                         \
    argument __VA_ARGS__;                                                                                  \
  } name##_arguments;                                                                                      \
  _Static_assert(sizeof(name##_arguments) % sizeof(argument) == 0, "it is read as an array of arguments"); \
  UNUSED static const char name##_parameters[] = NAMES_OF(__VA_ARGS__)

#define KERNEL(name, ...)                                                           \
  PARAMETERS(name, __VA_ARGS__);                                                    \
  static ast_status name##_body(const name##_arguments *, const int64_t *, void *); \
  static ast_status name##_run(const argument *a, const int64_t *n, void *result) { \
    return name##_body((const void *)a, n, result);                                 \
  }                                                                                 \
  static ast_status name##_body(const name##_arguments *a, UNUSED const int64_t *n, UNUSED void *result)

/* LIST_OF(MACRO, x, y, ...) is MACRO(x), MACRO(y), ... for up to 16 names. */
#define LIST_OF(MACRO, ...)      AGAIN(LIST_FROM(MACRO, __VA_ARGS__))
#define LIST_FROM(MACRO, x, ...) MACRO(x) __VA_OPT__(, LIST_NEXT PARENTHESES(MACRO, __VA_ARGS__))
#define LIST_NEXT()              LIST_FROM
#define PARENTHESES              ()
#define AGAIN(...)               AGAIN_4(AGAIN_4(AGAIN_4(AGAIN_4(__VA_ARGS__))))
#define AGAIN_4(...)             AGAIN_1(AGAIN_1(AGAIN_1(AGAIN_1(__VA_ARGS__))))
#define AGAIN_1(...)             __VA_ARGS__
/* Members of a struct of the core that have the name of a size or of a parameter, or of x where that is dx. */
#define SIZE(letter)   .letter = n[(int)*#letter]
#define FIELD(name)    .name = a->name.data
#define GRADIENT(name) .name = a->d##name.data

typedef ast_status (*run_function)(const argument *a, const int64_t *n, void *result);

/* Calls a kernel without the interpreter's lock; false with an exception set if there was no memory. */
static bool call_run(call *c, run_function function, void *result, ast_status *status) {
  *status = AST_OK;
  if (call_begin(c)) {
    Py_BEGIN_ALLOW_THREADS;
    *status = function(c->arguments, c->size, result);
    Py_END_ALLOW_THREADS;
  }
  return call_end(c, *status);
}

/* ---- sums of rows ---- */

KERNEL(segment_sum, x, node_order, node_offsets, mean, out) {
  return call_table()->segment_sum(a->x.data, n['F'], a->node_order.data, a->node_offsets.data, n['C'], a->mean.integer,
                                   a->out.data);
}

KERNEL(segment_spread, dout, node_order, node_offsets, mean, dx) {
  return call_table()->segment_spread(a->dout.data, n['F'], a->node_order.data, a->node_offsets.data, n['C'],
                                      a->mean.integer, a->dx.data);
}

KERNEL(column_sum, x, out) { return call_table()->column_sum(a->x.data, n['N'], n['F'], a->out.data); }

/* ---- the step of Muon ---- */

KERNEL(orthogonalize, x, out) { return call_table()->orthogonalize(a->x.data, n['K'], n['R'], n['C'], a->out.data); }

/* ---- elastic forces ---- */

#define ELASTIC position, rest_position, lame, elements, node_order, node_offsets
PARAMETERS(elastic_inputs, ELASTIC);

static ast_elastic elastic_of(const void *arguments, const int64_t *n) {
  const elastic_inputs_arguments *a = arguments;
  return (ast_elastic){LIST_OF(SIZE, N, E), LIST_OF(FIELD, ELASTIC)};
}

KERNEL(elastic_forces, ELASTIC, force) {
  const ast_elastic s = elastic_of(a, n);
  return call_table()->elastic_forces(&s, a->force.data);
}

KERNEL(elastic_forces_backward, dforce, ELASTIC, dposition) {
  const ast_elastic s = elastic_of(&a->position, n);
  return call_table()->elastic_forces_backward(&s, a->dforce.data, a->dposition.data);
}

/* ---- proximity ---- */

#define PROXIMITY position, motion, offsets, body, surface, surface_offsets

KERNEL(proximity, PROXIMITY, radius, out) {
  const ast_proximity s = {LIST_OF(SIZE, B, N, F), LIST_OF(FIELD, PROXIMITY), .radius = a->radius.number};
  return call_table()->proximity(&s, a->out.data);
}

static bool proximity_check(const call *c) {
  const proximity_arguments *a = (const void *)c->arguments;
  const float *position = a->position.data, *motion = a->motion.data;
  bool finite = true;
  for (int64_t i = 0; i < 3 * c->size['N']; i++) finite &= isfinite((double)position[i] + (double)motion[i]);
  return (finite && a->radius.number > 0 && isfinite(a->radius.number)) ||
         call_fail(c, "position, motion and radius must be finite, and the radius positive");
}

/* ---- the order of nodes ---- */

KERNEL(breadth_first, elements, wanted, rank) {
  return call_table()->breadth_first(a->elements.data, n['E'], n['K'], a->wanted.data, n['N'], a->rank.data);
}

/* ---- meshes ---- */

KERNEL(counting_sort, num, index, order, offsets) {
  return call_table()->counting_sort(a->index.data, n['M'], n['N'], a->order.data, a->offsets.data);
}

KERNEL(mesh_edges, num_nodes, elements, ends, senders, receivers, offsets) {
  return call_table()->mesh_edges(a->elements.data, n['E'], n['K'], a->ends.data, n['P'], n['N'], a->senders.data,
                                  a->receivers.data, a->offsets.data);
}

static bool mesh_edges_count(call *c, PyObject *list) {
  const mesh_edges_arguments *a = (const void *)c->arguments;
  ast_status status;
  c->size['M'] = 2 * c->size['P'] * c->size['E']; /* room; pages that stay empty take no memory */
  if (!call_make_outputs(c) || !call_run(c, mesh_edges_run, NULL, &status)) return false;
  c->size['M'] = ((const int64_t *)a->offsets.data)[c->size['N']];
  return call_append_outputs(c, list);
}

KERNEL(outer_faces, num_nodes, elements, faces, outer) {
  return call_table()->outer_faces(a->elements.data, n['E'], n['K'], a->faces.data, n['Q'], a->outer.data, result);
}

static bool outer_faces_count(call *c, PyObject *list) {
  ast_status status;
  int64_t num = 0;
  c->size['F'] = c->size['E'] * c->size['Q'];
  if (!call_make_outputs(c) || !call_run(c, outer_faces_run, &num, &status)) return false;
  c->size['F'] = num;
  return call_append_outputs(c, list);
}

/* ---- octree ---- */

KERNEL(octree, positions, offsets, x, y, z, half_width, depth, keys, cell_offsets, node_cell, node_order,
       node_offsets) {
  const double center[3] = {a->x.number, a->y.number, a->z.number};
  return call_table()->octree_build(a->positions.data, a->offsets.data, n['B'], center, a->half_width.number,
                                    (int)a->depth.integer, a->keys.data, a->cell_offsets.data, a->node_cell.data,
                                    a->node_order.data, a->node_offsets.data, result);
}

static bool octree_check(const call *c) {
  const octree_arguments *a = (const void *)c->arguments;
  bool finite = a->half_width.number > 0 && a->half_width.number < 1e300;
  for (const argument *x = &a->x; x <= &a->z; x++) finite &= x->number > -1e300 && x->number < 1e300;
  return finite || call_fail(c, "half_width must be positive, and it and center finite");
}

static bool octree_count(call *c, PyObject *list) {
  const octree_arguments *a = (const void *)c->arguments;
  ast_status status;
  int64_t bad = 0;
  c->size['C'] = c->size['N']; /* room for a cell a node */
  if (!call_make_outputs(c) || !call_run(c, octree_run, &bad, &status)) return false;
  if (status != AST_OK)
    return PyErr_Format(PyExc_ValueError, "octree: positions[%lld]: %s", (long long)bad, ast_status_text(status)),
           false;
  c->size['C'] = ((const int64_t *)a->cell_offsets.data)[c->size['B']];
  return call_append_outputs(c, list);
}

KERNEL(octree_coordinates, keys, coordinates) {
  return call_table()->octree_coordinates(a->keys.data, n['C'], a->coordinates.data);
}

KERNEL(octree_coarsen, keys, cell_offsets, levels, coarse_keys, coarse_offsets, first_child, node_cell, pair_offsets,
       fine, coarse, fine_by_fine, coarse_by_fine) {
  return call_table()->octree_coarsen(a->keys.data, a->cell_offsets.data, n['B'], (int)a->levels.integer, result);
}

static ast_status octree_coarsen_write(const argument *arguments, UNUSED const int64_t *n, void *result) {
  const octree_coarsen_arguments *a = (const void *)arguments;
  const ast_octree_level *level = result;
  memcpy(a->pair_offsets.data, level->pair_offsets, sizeof level->pair_offsets);
  return call_table()->octree_write_level(level, a->coarse_keys.data, a->coarse_offsets.data, a->first_child.data,
                                          a->node_cell.data, a->fine.data, a->coarse.data, a->fine_by_fine.data,
                                          a->coarse_by_fine.data);
}

/* The outputs of all levels. The list exists before the kernel runs, and arrays are no objects of the garbage
 * collector: so no Python code can use the thread's scratch memory while the levels lie there. */
static bool octree_coarsen_count(call *c, PyObject *list) {
  const int levels = (int)((const octree_coarsen_arguments *)(const void *)c->arguments)->levels.integer;
  AST_SCRATCH_SCOPE; /* of the levels */
  ast_octree_level level[21];
  ast_status status;
  bool ok = call_run(c, octree_coarsen_run, level, &status);
  if (ok && status == AST_TOO_LARGE) ok = call_fail(c, ast_status_text(status));
  for (int j = 0; ok && j < levels; j++) {
    c->size['N'] = level[j].C_fine;
    c->size['C'] = level[j].C;
    c->size['P'] = level[j].pair_offsets[27];
    ok = call_make_outputs(c) && call_run(c, octree_coarsen_write, &level[j], &status) && call_append_outputs(c, list);
  }
  return ok;
}

/* ---- farthest point sampling ---- */

/* out_offsets say where the samples of each scene lie: min(num, points) of each. */
KERNEL(farthest_point_sample, coordinates, offsets, num, indices, out_offsets) {
  const int64_t *offsets = a->offsets.data, num = a->num.integer;
  int64_t *out = a->out_offsets.data;
  out[0] = 0;
  for (int64_t b = 0; b < n['B']; b++) {
    const int64_t points = offsets[b + 1] - offsets[b];
    out[b + 1] = out[b] + (points < num ? points : num);
  }
  return call_table()->farthest_point_sample(a->coordinates.data, offsets, n['B'], num, out, a->indices.data);
}

static bool farthest_point_sample_count(call *c, PyObject *list) {
  const farthest_point_sample_arguments *a = (const void *)c->arguments;
  const int64_t points = c->size['C'], scenes = c->size['B'], num = a->num.integer;
  ast_status status;
  c->size['S'] = scenes && num <= (points - 1) / scenes ? scenes * num : points; /* room */
  if (!call_make_outputs(c) || !call_run(c, farthest_point_sample_run, NULL, &status)) return false;
  if (status != AST_OK) return call_fail(c, ast_status_text(status));
  c->size['S'] = ((const int64_t *)a->out_offsets.data)[scenes];
  return call_append_outputs(c, list);
}

/* ---- sparse convolution ---- */

/* Transposed, the spec gives the axes of the weight the other way round. */
KERNEL(sparse_conv, x, weight, bias, transposed, pair_offsets, source, destination, out) {
  const ast_pairs pairs = {a->pair_offsets.data, a->source.data, a->destination.data};
  return call_table()->sparse_conv(a->x.data, a->weight.data, a->bias.data, n['I'], n['O'], a->transposed.integer,
                                   pairs, n['R'], a->out.data);
}

KERNEL(sparse_conv_weight, x, dout, pair_offsets, source, destination, dweight) {
  const ast_pairs pairs = {a->pair_offsets.data, a->source.data, a->destination.data};
  return call_table()->sparse_conv_weight(a->x.data, a->dout.data, n['I'], n['O'], pairs, a->dweight.data);
}

/* ---- attention ---- */

#define ATTENTION q, k, v, q_offsets, k_offsets, scale, dropout_p, seed, out, maximum, total
PARAMETERS(attention_tokens, ATTENTION);

static bool attention_check(const call *c) {
  const int64_t D = c->size['D'];
  return (D % 16 == 0 && D >= 16 && D <= 128) || call_fail(c, "the head dimension must be a multiple of 16 up to 128");
}

static ast_attention attention_of(const void *arguments, const int64_t *n) {
  const attention_tokens_arguments *a = arguments;
  return (ast_attention){LIST_OF(SIZE, B, H, D),           LIST_OF(FIELD, q_offsets, k_offsets),
                         .q_stride = a->q.row_stride,      .k_stride = a->k.row_stride,
                         .v_stride = a->v.row_stride,      .scale = (float)a->scale.number,
                         .dropout_p = a->dropout_p.number, .seed = (uint64_t)a->seed.integer};
}

KERNEL(attention, ATTENTION) {
  const ast_attention s = attention_of(a, n);
  return call_table()->attention(&s, a->q.data, a->k.data, a->v.data, a->out.data, a->maximum.data, a->total.data);
}

KERNEL(attention_backward, ATTENTION, dout, dq, dk, dv) {
  ast_attention s = attention_of(a, n);
  s.dq_stride = a->dq.row_stride;
  s.dk_stride = a->dk.row_stride;
  s.dv_stride = a->dv.row_stride;
  return call_table()->attention_backward(&s, a->q.data, a->k.data, a->v.data, a->out.data, a->maximum.data,
                                          a->total.data, a->dout.data, a->dq.data, a->dk.data, a->dv.data);
}

/* ---- message passing ---- */

#define MESSAGE_FLOATS of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta
#define MESSAGE        MESSAGE_FLOATS, senders, receivers, receiver_offsets
PARAMETERS(message_inputs, MESSAGE);

static ast_message message_of(const void *arguments, const int64_t *n) {
  const message_inputs_arguments *a = arguments;
  return (ast_message){LIST_OF(SIZE, M, S, R, E, H, F), .F2 = n['G'], LIST_OF(FIELD, MESSAGE)};
}

/* Without an encoder edge features are added to of_senders and of_receivers; none at all are [M, 0]. */
static bool message_check(const call *c) {
  const int64_t E = c->size['E'];
  return c->size['H'] || !E || E == c->size['F'] ||
         call_fail(c, "edge_features without an encoder have other channels");
}

KERNEL(message, MESSAGE, sum, messages) {
  const ast_message s = message_of(a, n);
  return call_table()->message(&s, a->sum.data, a->messages.data);
}

KERNEL(message_backward, dsum, dmessages, MESSAGE, dof_senders, dof_receivers, dedge_features, dA1, da1, dA2, dW2, db2,
       dgamma, dbeta) {
  const ast_message s = message_of(&a->of_senders, n);
  const ast_message_gradients gradients = {LIST_OF(GRADIENT, MESSAGE_FLOATS)};
  return call_table()->message_backward(&s, a->dsum.data, a->dmessages.data, &gradients);
}

/* ---- dense layers ---- */

/* O outputs, or P pairs of them. */
static ast_linear linear_of(const argument *x, const argument *weight, const int64_t *n, int64_t activation) {
  const int64_t O = activation == AST_GEGLU ? 2 * n['P'] : n['O'];
  return (ast_linear){.M = n['M'],
                      .I = n['I'],
                      .O = O,
                      .x_stride = x->row_stride,
                      .weight_stride = weight->row_stride,
                      .activation = (ast_activation)activation};
}

KERNEL(linear, x, weight, bias, residual, activation, out, z) {
  ast_linear s = linear_of(&a->x, &a->weight, n, a->activation.integer);
  s.residual_stride = a->residual.row_stride;
  return call_table()->linear(&s, a->x.data, a->weight.data, a->bias.data, a->residual.data, a->out.data, a->z.data);
}

KERNEL(linear_backward, dout, x, weight, bias, z, activation, dx, dweight, dbias) {
  ast_linear s = linear_of(&a->x, &a->weight, n, a->activation.integer);
  s.dout_stride = a->dout.row_stride;
  return call_table()->linear_backward(&s, a->dout.data, a->x.data, a->weight.data, a->bias.data, a->z.data, a->dx.data,
                                       a->dweight.data, a->dbias.data);
}

#define MLP x, beside, weight1, bias1, weight2, bias2, gamma, beta
PARAMETERS(mlp_inputs, MLP);

static ast_mlp mlp_of(const void *arguments, const int64_t *n) {
  const mlp_inputs_arguments *a = arguments;
  return (ast_mlp){LIST_OF(SIZE, M, I, H, O), .I2 = n['J'], .x_stride = a->x.row_stride,
                   .beside_stride = a->beside.row_stride, LIST_OF(FIELD, MLP)};
}

#define MLP_KEPT hidden, normalized, scale

KERNEL(mlp, MLP, residual, out, MLP_KEPT) {
  ast_mlp s = mlp_of(a, n);
  s.residual_stride = a->residual.row_stride;
  return call_table()->mlp(&s, a->residual.data, a->out.data, (ast_mlp_kept){LIST_OF(FIELD, MLP_KEPT)});
}

KERNEL(mlp_backward, dout, MLP, MLP_KEPT, dx, dbeside, dweight1, dbias1, dweight2, dbias2, dgamma, dbeta) {
  ast_mlp s = mlp_of(&a->x, n);
  s.dout_stride = a->dout.row_stride;
  return call_table()->mlp_backward(&s, a->dout.data, (ast_mlp_kept){LIST_OF(FIELD, MLP_KEPT)},
                                    (ast_mlp_gradients){LIST_OF(GRADIENT, MLP)});
}

/* ---- attention blocks ---- */

#define BLOCK_ROWS x, context, rotations, context_rotations, q_offsets, k_offsets
#define BLOCK_WEIGHTS                                                                                       \
  gamma, beta, context_gamma, context_beta, query, key_value, weight, bias, inner_gamma, inner_beta, first, \
      first_bias, second, second_bias

#define BLOCK_KEPT queries, keys_values, mixed, maximum, total, y, z, hidden
PARAMETERS(block_inputs, BLOCK_ROWS, BLOCK_WEIGHTS);

static ast_attention_block block_of(const void *arguments, const int64_t *n) {
  const block_inputs_arguments *a = arguments;
  return (ast_attention_block){LIST_OF(SIZE, B, Q, K, W, C, F, H), .D = n['I'] / n['H'], LIST_OF(FIELD, BLOCK_ROWS),
                               LIST_OF(FIELD, BLOCK_WEIGHTS)};
}

KERNEL(attention_block, BLOCK_ROWS, BLOCK_WEIGHTS, heads, out, BLOCK_KEPT) {
  const ast_attention_block s = block_of(a, n);
  return call_table()->attention_block(&s, a->out.data, (ast_attention_block_kept){LIST_OF(FIELD, BLOCK_KEPT)});
}

KERNEL(attention_block_backward, dout, BLOCK_ROWS, BLOCK_WEIGHTS, heads, BLOCK_KEPT, dx, dcontext, dgamma, dbeta,
       dcontext_gamma, dcontext_beta, dquery, dkey_value, dweight, dbias, dinner_gamma, dinner_beta, dfirst,
       dfirst_bias, dsecond, dsecond_bias) {
  const ast_attention_block s = block_of(&a->x, n);
  return call_table()->attention_block_backward(
      &s, a->dout.data, (ast_attention_block_kept){LIST_OF(FIELD, BLOCK_KEPT)},
      (ast_attention_block_gradients){LIST_OF(GRADIENT, x, context), LIST_OF(GRADIENT, BLOCK_WEIGHTS)});
}

static bool block_check(const call *c, const void *arguments) {
  const block_inputs_arguments *a = arguments;
  const int64_t I = c->size['I'], H = c->size['H'], D = H ? I / H : 0;
  const bool rotated = a->rotations.data || a->context_rotations.data;
  return (H && I % H == 0 && D % 16 == 0 && D >= 16 && D <= 128 && (!rotated || c->size['E'] == D)) ||
         call_fail(c, "the head dimension must be a multiple of 16 up to 128, and the dimension of the rotations");
}

static bool attention_block_check(const call *c) { return block_check(c, c->arguments); }
static bool attention_block_backward_check(const call *c) { return block_check(c, c->arguments + 1); }

/* ---- all kernels ---- */

typedef struct {
  spec spec;
  run_function run;
  bool (*check)(const call *c);           /* what a spec cannot say; may be NULL */
  bool (*count)(call *c, PyObject *list); /* runs a kernel that counts its outputs, and lists them; may be NULL */
} binding;

#define BINDING(name, ...) BINDING_AS(#name, name, __VA_ARGS__)
#define BINDING_AS(text, kernel, ...) \
  {.spec.name = text, .spec.names = kernel##_parameters, .run = kernel##_run, __VA_ARGS__}

#define COUNTED(kernel) .spec.counts = true, .count = kernel##_count

static binding bindings[] = {
    BINDING(attention, .check = attention_check),
    BINDING(attention_backward, .check = attention_check),
    BINDING(attention_block, .check = attention_block_check),
    BINDING(attention_block_backward, .check = attention_block_backward_check),
    BINDING(breadth_first),
    BINDING(counting_sort),
    BINDING(mesh_edges, COUNTED(mesh_edges)),
    BINDING(outer_faces, COUNTED(outer_faces)),
    BINDING(column_sum),
    BINDING(elastic_forces),
    BINDING(elastic_forces_backward),
    BINDING(farthest_point_sample, COUNTED(farthest_point_sample)),
    BINDING(linear),
    BINDING(linear_backward),
    BINDING_AS("linear_geglu", linear),
    BINDING_AS("linear_geglu_backward", linear_backward),
    BINDING(message, .check = message_check),
    BINDING(message_backward, .check = message_check),
    BINDING(mlp),
    BINDING(mlp_backward),
    BINDING(octree, COUNTED(octree), .check = octree_check),
    BINDING(octree_coarsen, COUNTED(octree_coarsen)),
    BINDING(octree_coordinates),
    BINDING(orthogonalize),
    BINDING(proximity, .check = proximity_check),
    BINDING(segment_spread),
    BINDING(segment_sum),
    BINDING(sparse_conv),
    BINDING_AS("sparse_conv_transposed", sparse_conv),
    BINDING(sparse_conv_weight),
};

#endif
