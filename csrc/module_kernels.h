/* How each kernel is called with the arguments that its spec in ast_sim/ops has taken apart. Included by module.c
 * alone.
 *
 * KERNEL(name, parameters...) { body } names the parameters in the order of the spec, which is compared with them at
 * import. In the body `a` are the arguments by name, `n` the sizes by letter of the spec, and `result` is what takes
 * more than a status.
 */
#ifndef AST_MODULE_KERNELS_H
#define AST_MODULE_KERNELS_H

#include "arguments.h"

#define NAMES_OF(...) #__VA_ARGS__
#define PARAMETERS(name, ...) \
  typedef struct {            \
    argument __VA_ARGS__;     \
  } name##_arguments;         \
  static const char name##_parameters[] = NAMES_OF(__VA_ARGS__)

#define KERNEL(name, ...)                                                           \
  PARAMETERS(name, __VA_ARGS__);                                                    \
  static ast_status name##_body(const name##_arguments *, const int64_t *, void *); \
  static ast_status name##_run(const argument *a, const int64_t *n, void *result) { \
    return name##_body((const void *)a, n, result);                                 \
  }                                                                                 \
  static ast_status name##_body(const name##_arguments *a, const int64_t *n, NOT_ALWAYS result)
#define NOT_ALWAYS __attribute__((unused)) void *

typedef ast_status (*run_function)(const argument *a, const int64_t *n, void *result);

/* Calls a kernel without the interpreter's lock; false with an exception set if there was no memory. */
static bool run(call *c, run_function function, void *result, ast_status *status) {
  *status = AST_OK;
  if (begin(c)) {
    Py_BEGIN_ALLOW_THREADS;
    *status = function(c->arguments, c->size, result);
    Py_END_ALLOW_THREADS;
  }
  return end(c, *status);
}

/* ---- sums of rows ---- */

KERNEL(segment_sum, x, node_order, node_offsets, mean, out) {
  return kernels->segment_sum(a->x.data, n['F'], a->node_order.data, a->node_offsets.data, n['C'], a->mean.integer,
                              a->out.data);
}

KERNEL(segment_spread, dout, node_order, node_offsets, mean, dx) {
  return kernels->segment_spread(a->dout.data, n['F'], a->node_order.data, a->node_offsets.data, n['C'],
                                 a->mean.integer, a->dx.data);
}

KERNEL(column_sum, x, out) { return kernels->column_sum(a->x.data, n['N'], n['F'], a->out.data); }

/* ---- elastic forces ---- */

KERNEL(elastic_forces, position, rest_position, lame, elements, node_order, node_offsets, force) {
  const ast_elastic s = {n['N'],
                         n['E'],
                         a->elements.data,
                         a->node_order.data,
                         a->node_offsets.data,
                         a->position.data,
                         a->rest_position.data,
                         a->lame.data};
  return kernels->elastic_forces(&s, a->force.data);
}

KERNEL(elastic_forces_backward, position, rest_position, lame, elements, node_order, node_offsets, dforce, dposition) {
  const ast_elastic s = {n['N'],
                         n['E'],
                         a->elements.data,
                         a->node_order.data,
                         a->node_offsets.data,
                         a->position.data,
                         a->rest_position.data,
                         a->lame.data};
  return kernels->elastic_forces_backward(&s, a->dforce.data, a->dposition.data);
}

/* ---- octree ---- */

KERNEL(octree, positions, offsets, x, y, z, half_width, depth, keys, cell_offsets, node_cell, node_order,
       node_offsets) {
  const double center[3] = {a->x.number, a->y.number, a->z.number};
  return kernels->octree_build(a->positions.data, a->offsets.data, n['B'], center, a->half_width.number,
                               (int)a->depth.integer, a->keys.data, a->cell_offsets.data, a->node_cell.data,
                               a->node_order.data, a->node_offsets.data, result);
}

static bool octree_check(const call *c) {
  const octree_arguments *a = (const void *)c->arguments;
  if (!(a->half_width.number > 0 && a->half_width.number < 1e300))
    return fail(c, PyExc_ValueError, "half_width must be positive and finite");
  for (const argument *x = &a->x; x <= &a->z; x++)
    if (!(x->number > -1e300 && x->number < 1e300)) return fail(c, PyExc_ValueError, "center must be finite");
  return true;
}

/* The number of cells; the outputs have room for as many as there are nodes. */
static PyObject *octree_result(call *c) {
  const octree_arguments *a = (const void *)c->arguments;
  ast_status status;
  int64_t bad = 0;
  if (!run(c, octree_run, &bad, &status)) return NULL;
  if (status == AST_OK) return PyLong_FromLongLong(((const int64_t *)a->cell_offsets.data)[c->size['B']]);
  const float *p = (const float *)a->positions.data + 3 * bad;
  char place[120], problem[80] = "is not finite";
  snprintf(place, sizeof place, "(%.9g, %.9g, %.9g)", (double)p[0], (double)p[1], (double)p[2]);
  if (status == AST_OUTSIDE)
    snprintf(problem, sizeof problem, "lies outside the domain of half width %.9g", a->half_width.number);
  return fail(c, PyExc_ValueError, "positions[%lld] = %s %s", (long long)bad, place, problem), NULL;
}

KERNEL(octree_coordinates, keys, coordinates) {
  return kernels->octree_coordinates(a->keys.data, n['C'], a->coordinates.data);
}

KERNEL(octree_coarsen, keys, cell_offsets, levels) {
  return kernels->octree_coarsen(a->keys.data, a->cell_offsets.data, n['B'], (int)a->levels.integer, result);
}

/* Of a level: keys, cell_offsets, first_child, node_cell, pair_offsets, fine, coarse, fine_by_fine, coarse_by_fine.
 * Their sizes are known only half-way, so they are made here. */
enum { LEVEL_ARRAYS = 9 };

/* Puts the arrays of a level into the list, from `at` on; false with an exception set if there is no memory. */
static bool append_level(PyObject *list, const ast_octree_level *level, Py_ssize_t at) {
  const int64_t pairs = level->pair_offsets[27];
  const int64_t lengths[LEVEL_ARRAYS] = {level->C, level->B + 1, level->C + 1, level->C_fine, 28,
                                         pairs,    pairs,        pairs,        pairs};
  frozen *made[LEVEL_ARRAYS];
  int64_t *data[LEVEL_ARRAYS];
  for (int i = 0; i < LEVEL_ARRAYS; i++) {
    PyObject *array =
        (made[i] = new_frozen(lengths[i] * (int64_t)sizeof *data[i])) ? array_of(made[i], 1, &lengths[i]) : NULL;
    if (!array || PyList_SetItem(list, at + i, array)) return false;
    data[i] = made[i]->hidden;
    if (debug) memset(data[i], 0xff, (size_t)made[i]->bytes);
  }
  memcpy(data[4], level->pair_offsets, sizeof level->pair_offsets);
  ast_status status;
  Py_BEGIN_ALLOW_THREADS;
  status = kernels->octree_write_level(level, data[0], data[1], data[2], data[3], data[5], data[6], data[7], data[8]);
  for (int i = 0; i < LEVEL_ARRAYS; i++) show(made[i]);
  Py_END_ALLOW_THREADS;
  return status == AST_OK || (PyErr_NoMemory(), false);
}

/* The list of all levels' arrays. It exists before the kernel runs, and arrays are no objects of the garbage collector:
 * so no Python code can use the thread's scratch memory while the levels lie there. */
static PyObject *octree_coarsen_result(call *c) {
  const octree_coarsen_arguments *a = (const void *)c->arguments;
  const int levels = (int)a->levels.integer;
  AST_SCRATCH_SCOPE; /* of the levels */
  ast_octree_level level[21];
  ast_status status;
  PyObject *list = PyList_New((Py_ssize_t)levels * LEVEL_ARRAYS);
  if (!list) return NULL;
  bool ok = run(c, octree_coarsen_run, level, &status);
  if (ok && status == AST_TOO_LARGE)
    ok = fail(c, PyExc_ValueError, "keys must be fewer than 2^31, not %lld", (long long)c->size['C']);
  for (int j = 0; ok && j < levels; j++) ok = append_level(list, &level[j], (Py_ssize_t)j * LEVEL_ARRAYS);
  if (!ok) Py_CLEAR(list);
  return list;
}

/* ---- farthest point sampling ---- */

/* out_offsets say where the samples of each scene lie: min(num, points) of each. */
KERNEL(farthest_point_sample, coordinates, offsets, num, out_offsets, indices) {
  const int64_t *offsets = a->offsets.data, num = a->num.integer;
  int64_t *out = a->out_offsets.data;
  out[0] = 0;
  for (int64_t b = 0; b < n['B']; b++) {
    const int64_t points = offsets[b + 1] - offsets[b];
    out[b + 1] = out[b] + (points < num ? points : num);
  }
  return kernels->farthest_point_sample(a->coordinates.data, offsets, n['B'], num, out, a->indices.data);
}

static bool farthest_point_sample_check(const call *c) {
  const farthest_point_sample_arguments *a = (const void *)c->arguments;
  const int64_t points = c->size['C'], scenes = c->size['B'], num = a->num.integer, room = c->size['S'];
  const int64_t most = scenes && num <= (points - 1) / scenes ? scenes * num : points;
  if (room >= most) return true;
  return fail(c, PyExc_ValueError, "indices must have room for %lld samples, not %lld", (long long)most,
              (long long)room);
}

/* The first scene with two coordinates on one axis that differ by 2^21 or more, or -1. */
static int64_t too_wide(const int32_t *coordinates, const int64_t *offsets, int64_t B) {
  for (int64_t b = 0; b < B; b++)
    for (int a = 0; a < 3; a++) {
      int64_t low = INT64_MAX, high = INT64_MIN;
      for (int64_t i = offsets[b]; i < offsets[b + 1]; i++) {
        const int64_t x = coordinates[3 * i + a];
        low = x < low ? x : low;
        high = x > high ? x : high;
      }
      if (offsets[b] < offsets[b + 1] && high - low >= 1 << 21) return b;
    }
  return -1;
}

/* The number of samples. */
static PyObject *farthest_point_sample_result(call *c) {
  const farthest_point_sample_arguments *a = (const void *)c->arguments;
  ast_status status;
  if (!run(c, farthest_point_sample_run, NULL, &status)) return NULL;
  if (status == AST_OK) return PyLong_FromLongLong(((const int64_t *)a->out_offsets.data)[c->size['B']]);
  const int64_t scene = too_wide(a->coordinates.data, a->offsets.data, c->size['B']);
  return fail(c, PyExc_ValueError, "coordinates of scene %lld differ by 2^21 or more", (long long)scene), NULL;
}

/* ---- sparse convolution ---- */

/* Transposed, the spec gives the axes of the weight the other way round. */
KERNEL(sparse_conv, x, weight, bias, transposed, pair_offsets, source, destination, out) {
  const ast_pairs pairs = {a->pair_offsets.data, a->source.data, a->destination.data};
  return kernels->sparse_conv(a->x.data, a->weight.data, a->bias.data, n['I'], n['O'], a->transposed.integer, pairs,
                              n['R'], a->out.data);
}

KERNEL(sparse_conv_weight, x, dout, pair_offsets, source, destination, dweight) {
  const ast_pairs pairs = {a->pair_offsets.data, a->source.data, a->destination.data};
  return kernels->sparse_conv_weight(a->x.data, a->dout.data, n['I'], n['O'], pairs, a->dweight.data);
}

/* ---- attention ---- */

#define ATTENTION q, k, v, q_offsets, k_offsets, scale, dropout_p, seed
PARAMETERS(attention_inputs, ATTENTION);

static ast_attention attention_of(const void *arguments, const int64_t *n) {
  const attention_inputs_arguments *a = arguments;
  return (ast_attention){.B = n['B'],
                         .H = n['H'],
                         .D = n['D'],
                         .q_offsets = a->q_offsets.data,
                         .k_offsets = a->k_offsets.data,
                         .q_stride = a->q.row_stride,
                         .k_stride = a->k.row_stride,
                         .v_stride = a->v.row_stride,
                         .scale = (float)a->scale.number,
                         .dropout_p = a->dropout_p.number,
                         .seed = (uint64_t)a->seed.integer};
}

static bool attention_check(const call *c) {
  const attention_inputs_arguments *a = (const void *)c->arguments;
  const int64_t D = c->size['D'];
  if (D % 16 || D < 16 || D > 128)
    return fail(c, PyExc_ValueError, "the head dimension must be a multiple of 16 up to 128, not %lld", (long long)D);
  if (!(a->dropout_p.number >= 0 && a->dropout_p.number < 1))
    return fail(c, PyExc_ValueError, "dropout_p must lie in [0, 1)");
  return true;
}

KERNEL(attention, ATTENTION, out, maximum, sum) {
  const ast_attention s = attention_of(a, n);
  return kernels->attention(&s, a->q.data, a->k.data, a->v.data, a->out.data, a->maximum.data, a->sum.data);
}

KERNEL(attention_backward, ATTENTION, out, maximum, sum, dout, dq, dk, dv) {
  ast_attention s = attention_of(a, n);
  s.dq_stride = a->dq.row_stride;
  s.dk_stride = a->dk.row_stride;
  s.dv_stride = a->dv.row_stride;
  return kernels->attention_backward(&s, a->q.data, a->k.data, a->v.data, a->out.data, a->maximum.data, a->sum.data,
                                     a->dout.data, a->dq.data, a->dk.data, a->dv.data);
}

/* ---- message passing ---- */

#define MESSAGE \
  of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, receiver_offsets
PARAMETERS(message_inputs, MESSAGE);

static ast_message message_of(const void *arguments, const int64_t *n) {
  const message_inputs_arguments *a = arguments;
  return (ast_message){.M = n['M'],
                       .S = n['S'],
                       .R = n['R'],
                       .E = n['E'],
                       .H = n['H'],
                       .F = n['F'],
                       .F2 = n['G'],
                       .senders = a->senders.data,
                       .receivers = a->receivers.data,
                       .receiver_offsets = a->receiver_offsets.data,
                       .of_senders = a->of_senders.data,
                       .of_receivers = a->of_receivers.data,
                       .edge_features = a->edge_features.data,
                       .A1 = a->A1.data,
                       .a1 = a->a1.data,
                       .A2 = a->A2.data,
                       .W2 = a->W2.data,
                       .b2 = a->b2.data,
                       .gamma = a->gamma.data,
                       .beta = a->beta.data};
}

/* Without an encoder edge features are added to of_senders and of_receivers; none at all are [M, 0]. */
static bool message_check(const call *c) {
  const int64_t E = c->size['E'], F = c->size['F'];
  if (c->size['H'] || !E || E == F) return true;
  return fail(c, PyExc_ValueError,
              "edge_features without an encoder must have the %lld channels of of_senders, not %lld", (long long)F,
              (long long)E);
}

KERNEL(message, MESSAGE, sum, messages) {
  const ast_message s = message_of(a, n);
  return kernels->message(&s, a->sum.data, a->messages.data);
}

KERNEL(message_backward, MESSAGE, dsum, dmessages, dof_senders, dof_receivers, dedge_features, dA1, da1, dA2, dW2, db2,
       dgamma, dbeta) {
  const ast_message s = message_of(a, n);
  const ast_message_gradients out = {
      a->dof_senders.data, a->dof_receivers.data, a->dedge_features.data, a->dA1.data,  a->da1.data, a->dA2.data,
      a->dW2.data,         a->db2.data,           a->dgamma.data,         a->dbeta.data};
  return kernels->message_backward(&s, a->dsum.data, a->dmessages.data, &out);
}

/* ---- dense layers ---- */

/* O outputs, or P pairs of them. */
static ast_linear linear_of(const argument *x, const int64_t *n, int64_t activation) {
  const int64_t O = activation == AST_GEGLU ? 2 * n['P'] : n['O'];
  return (ast_linear){
      .M = n['M'], .I = n['I'], .O = O, .x_stride = x->row_stride, .activation = (ast_activation)activation};
}

KERNEL(linear, x, weight, bias, residual, activation, out, z) {
  ast_linear s = linear_of(&a->x, n, a->activation.integer);
  s.residual_stride = a->residual.row_stride;
  return kernels->linear(&s, a->x.data, a->weight.data, a->bias.data, a->residual.data, a->out.data, a->z.data);
}

KERNEL(linear_backward, x, weight, bias, z, activation, dout, dx, dweight, dbias) {
  ast_linear s = linear_of(&a->x, n, a->activation.integer);
  s.dout_stride = a->dout.row_stride;
  return kernels->linear_backward(&s, a->dout.data, a->x.data, a->weight.data, a->bias.data, a->z.data, a->dx.data,
                                  a->dweight.data, a->dbias.data);
}

#define MLP x, beside, weight1, bias1, weight2, bias2, gamma, beta
PARAMETERS(mlp_inputs, MLP);

static ast_mlp mlp_of(const void *arguments, const int64_t *n) {
  const mlp_inputs_arguments *a = arguments;
  return (ast_mlp){.M = n['M'],
                   .I = n['I'],
                   .I2 = n['J'],
                   .H = n['H'],
                   .O = n['O'],
                   .x_stride = a->x.row_stride,
                   .beside_stride = a->beside.row_stride,
                   .x = a->x.data,
                   .beside = a->beside.data,
                   .weight1 = a->weight1.data,
                   .bias1 = a->bias1.data,
                   .weight2 = a->weight2.data,
                   .bias2 = a->bias2.data,
                   .gamma = a->gamma.data,
                   .beta = a->beta.data};
}

KERNEL(mlp, MLP, residual, out, hidden, normalized, scale) {
  ast_mlp s = mlp_of(a, n);
  s.residual_stride = a->residual.row_stride;
  return kernels->mlp(&s, a->residual.data, a->out.data,
                      (ast_mlp_kept){a->hidden.data, a->normalized.data, a->scale.data});
}

KERNEL(mlp_backward, MLP, dout, hidden, normalized, scale, dx, dbeside, dweight1, dbias1, dweight2, dbias2, dgamma,
       dbeta) {
  ast_mlp s = mlp_of(a, n);
  s.dout_stride = a->dout.row_stride;
  const ast_mlp_kept kept = {a->hidden.data, a->normalized.data, a->scale.data};
  const ast_mlp_gradients gradients = {a->dx.data,       a->dbeside.data, a->dweight1.data, a->dbias1.data,
                                       a->dweight2.data, a->dbias2.data,  a->dgamma.data,   a->dbeta.data};
  return kernels->mlp_backward(&s, a->dout.data, kept, gradients);
}

/* ---- all kernels ---- */

typedef struct {
  const char *name, *parameters;
  run_function run;
  bool (*check)(const call *c); /* what a spec cannot say; may be NULL */
  PyObject *(*result)(call *c); /* runs the kernel where it returns more than None; may be NULL */
  spec spec;
} binding;

#define BINDING(name, ...) BINDING_AS(#name, name, __VA_ARGS__)
#define BINDING_AS(text, kernel, ...) \
  {.name = text, .parameters = kernel##_parameters, .run = kernel##_run, __VA_ARGS__}

static binding bindings[] = {
    BINDING(attention, .check = attention_check),
    BINDING(attention_backward, .check = attention_check),
    BINDING(column_sum),
    BINDING(elastic_forces),
    BINDING(elastic_forces_backward),
    BINDING(farthest_point_sample, .check = farthest_point_sample_check, .result = farthest_point_sample_result),
    BINDING(linear),
    BINDING(linear_backward),
    BINDING_AS("linear_geglu", linear),
    BINDING_AS("linear_geglu_backward", linear_backward),
    BINDING(message, .check = message_check),
    BINDING(message_backward, .check = message_check),
    BINDING(mlp),
    BINDING(mlp_backward),
    BINDING(octree, .check = octree_check, .result = octree_result),
    BINDING(octree_coarsen, .result = octree_coarsen_result),
    BINDING(octree_coordinates),
    BINDING(segment_spread),
    BINDING(segment_sum),
    BINDING(sparse_conv),
    BINDING_AS("sparse_conv_transposed", sparse_conv),
    BINDING(sparse_conv_weight),
};

#endif
