/* The Python module ast_sim._C: checks every argument (arguments.h), then calls a kernel with the GIL released. */
#include "arguments.h"

static const ast_kernels *kernels;

static int64_t *ints_of(PyObject *array) { return PyArray_DATA((PyArrayObject *)array); }

/* A new array, filled with -1 in debug mode: for outputs whose sizes follow from the values of the inputs. */
static PyObject *new_ints(int64_t length) {
  npy_intp shape[1] = {(npy_intp)length};
  PyObject *array = PyArray_SimpleNew(1, shape, INTS);
  if (array && debug) memset(ints_of(array), 0xff, (size_t)length * sizeof(int64_t));
  return array;
}

/* ---- segments ---- */

static PyObject *segment(const char *op, PyObject *const *objects, Py_ssize_t num, bool spread) {
  call c;
  argument *x, *order, *offsets, *out;
  int64_t mean;
  ast_status status;
  if (!start(&c, op, objects, num, 5) || !(x = IN(&c, "x", FLOATS, 2, FREE, FREE)) ||
      !(order = IN(&c, "node_order", INTS, 1, spread ? FREE : x->shape[0])) ||
      !(offsets = IN(&c, "node_offsets", INTS, 1, spread ? x->shape[0] + 1 : FREE)) || !take_int(&c, "mean", 0, 1, &mean) ||
      !check_offsets(&c, offsets, order->shape[0]) ||
      !(out = OUT(&c, "out", FLOATS, 2, spread ? order->shape[0] : offsets->shape[0] - 1, x->shape[1])) ||
      !check_permutation(&c, order, order->shape[0]))
    return NULL;
  KERNEL(c, status,
         (spread ? kernels->segment_spread : kernels->segment_sum)(x->data, x->shape[1], order->data, offsets->data, offsets->shape[0] - 1,
                                                                   mean, out->data));
  Py_RETURN_NONE;
}

static PyObject *segment_sum(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  return segment("segment_sum", objects, num, false);
}

static PyObject *segment_spread(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  return segment("segment_spread", objects, num, true);
}

static PyObject *column_sum(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *x, *out;
  ast_status status;
  if (!start(&c, "column_sum", objects, num, 2) || !(x = IN(&c, "x", FLOATS, 2, FREE, FREE)) ||
      !(out = OUT(&c, "out", FLOATS, 1, x->shape[1])))
    return NULL;
  KERNEL(c, status, kernels->column_sum(x->data, x->shape[0], x->shape[1], out->data));
  Py_RETURN_NONE;
}

/* ---- octree ---- */

static PyObject *octree_error(const call *c, ast_status status, const float *p, int64_t node, double half_width) {
  char text[200];
  int used =
      snprintf(text, sizeof text, "positions[%lld] = (%.9g, %.9g, %.9g) ", (long long)node, (double)p[0], (double)p[1], (double)p[2]);
  if (status == AST_NOT_FINITE) snprintf(text + used, sizeof text - (size_t)used, "is not finite");
  else snprintf(text + used, sizeof text - (size_t)used, "lies outside the domain of half width %.9g", half_width);
  fail(c, PyExc_ValueError, "%s", text);
  return NULL;
}

static PyObject *octree_build(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *positions, *offsets, *keys, *cell_offsets, *node_cell, *node_order, *node_offsets;
  double center[3], half_width;
  int64_t depth, bad = -1;
  ast_status status;
  if (!start(&c, "octree", objects, num, 12) || !(positions = IN(&c, "positions", FLOATS, 2, FREE, (int64_t)3)) ||
      !(offsets = IN(&c, "offsets", INTS, 1, FREE)) || !check_offsets(&c, offsets, positions->shape[0]) || !take_float(&c, &center[0]) ||
      !take_float(&c, &center[1]) || !take_float(&c, &center[2]) || !take_float(&c, &half_width) || !take_int(&c, "depth", 0, 21, &depth))
    return NULL;
  if (!(half_width > 0 && half_width < 1e300)) {
    PyErr_SetString(PyExc_ValueError, "octree: half_width must be positive and finite");
    return NULL;
  }
  for (int a = 0; a < 3; a++)
    if (!(center[a] > -1e300 && center[a] < 1e300)) {
      PyErr_SetString(PyExc_ValueError, "octree: center must be finite");
      return NULL;
    }
  const int64_t N = positions->shape[0], B = offsets->shape[0] - 1;
  if (!(keys = OUT(&c, "keys", INTS, 1, N)) || !(cell_offsets = OUT(&c, "cell_offsets", INTS, 1, B + 1)) ||
      !(node_cell = OUT(&c, "node_cell", INTS, 1, N)) || !(node_order = OUT(&c, "node_order", INTS, 1, N)) ||
      !(node_offsets = OUT(&c, "node_offsets", INTS, 1, N + 1)))
    return NULL;
  KERNEL(c, status,
         kernels->octree_build(positions->data, offsets->data, B, center, half_width, (int)depth, keys->data, cell_offsets->data,
                               node_cell->data, node_order->data, node_offsets->data, &bad));
  if (status != AST_OK) return octree_error(&c, status, (const float *)positions->data + 3 * bad, bad, half_width);
  Py_RETURN_NONE;
}

/* Keys that rise strictly within each scene. */
static bool check_keys(const call *c, const argument *keys, const argument *offsets) {
  const int64_t *key = keys->data, *offset = offsets->data;
  for (int64_t b = 0; b + 1 < offsets->shape[0]; b++)
    for (int64_t i = offset[b]; i < offset[b + 1]; i++)
      if (key[i] < 0 || (i > offset[b] && key[i] <= key[i - 1]))
        return fail(c, PyExc_ValueError, "%s must be at least 0 and rise strictly within each scene, but %s[%lld] is %lld", keys->name,
                    keys->name, (long long)i, (long long)key[i]);
  return true;
}

static PyObject *octree_coordinates(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *keys, *coordinates;
  ast_status status;
  if (!start(&c, "octree_coordinates", objects, num, 2) || !(keys = IN(&c, "keys", INTS, 1, FREE)) ||
      !(coordinates = OUT(&c, "coordinates", SMALL_INTS, 2, keys->shape[0], (int64_t)3)))
    return NULL;
  KERNEL(c, status, kernels->octree_coordinates(keys->data, keys->shape[0], coordinates->data));
  Py_RETURN_NONE;
}

/* Of a level: keys, cell_offsets, first_child, node_cell, pair_offsets, fine, coarse, fine_by_fine, coarse_by_fine. Their sizes are known
 * only half-way, so they are made here. */
enum { LEVEL_ARRAYS = 9 };

/* Puts the arrays of a level into the list, from `at` on; false with an exception set if there is no memory. */
static bool append_level(PyObject *list, const ast_octree_level *level, Py_ssize_t at) {
  const int64_t pairs = level->pair_offsets[27];
  const int64_t lengths[LEVEL_ARRAYS] = {level->C, level->B + 1, level->C + 1, level->C_fine, 28, pairs, pairs, pairs, pairs};
  int64_t *data[LEVEL_ARRAYS];
  for (int i = 0; i < LEVEL_ARRAYS; i++) {
    PyObject *array = new_ints(lengths[i]);
    if (!array) return false;
    data[i] = ints_of(array);
    if (PyList_SetItem(list, at + i, array)) return false;
  }
  memcpy(data[4], level->pair_offsets, sizeof level->pair_offsets);
  ast_status status;
  Py_BEGIN_ALLOW_THREADS;
  status = kernels->octree_write_level(level, data[0], data[1], data[2], data[3], data[5], data[6], data[7], data[8]);
  Py_END_ALLOW_THREADS;
  return status == AST_OK || (PyErr_NoMemory(), false);
}

/* The list, filled, or NULL. It exists before the first kernel runs, and arrays are no objects of the garbage collector: so no Python
 * code can use the thread's scratch memory while the levels lie there. */
static PyObject *fill_levels(call *c, const argument *keys, const argument *offsets, int levels, PyObject *list) {
  ast_octree_level level[21];
  ast_status status;
  KERNEL(*c, status, kernels->octree_coarsen(keys->data, offsets->data, offsets->shape[0] - 1, levels, level));
  if (status == AST_TOO_LARGE) {
    fail(c, PyExc_ValueError, "keys must be fewer than 2^31, not %lld", (long long)keys->shape[0]);
    return NULL;
  }
  for (int j = 0; j < levels; j++)
    if (!append_level(list, &level[j], (Py_ssize_t)j * LEVEL_ARRAYS)) return NULL;
  return list;
}

static PyObject *octree_coarsen(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *keys, *offsets;
  int64_t levels;
  if (!start(&c, "octree_coarsen", objects, num, 3) || !(keys = IN(&c, "keys", INTS, 1, FREE)) ||
      !(offsets = IN(&c, "cell_offsets", INTS, 1, FREE)) || !take_int(&c, "levels", 0, 21, &levels) ||
      !check_offsets(&c, offsets, keys->shape[0]) || !check_keys(&c, keys, offsets))
    return NULL;
  PyObject *list = PyList_New((Py_ssize_t)levels * LEVEL_ARRAYS);
  if (list && !fill_levels(&c, keys, offsets, (int)levels, list)) Py_CLEAR(list);
  return list;
}

/* ---- farthest point sampling ---- */

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

/* Where the samples of each scene go: min(num, points) of each. */
static PyObject *sample_offsets(const int64_t *offsets, int64_t B, int64_t num) {
  PyObject *array = new_ints(B + 1);
  if (!array) return NULL;
  int64_t *out = ints_of(array);
  out[0] = 0;
  for (int64_t b = 0; b < B; b++) {
    const int64_t points = offsets[b + 1] - offsets[b];
    out[b + 1] = out[b] + (points < num ? points : num);
  }
  return array;
}

/* Both arrays, the indices filled, or NULL. */
static PyObject *sample_into(call *c, const argument *coordinates, const argument *offsets, int64_t num, PyObject *indices,
                             PyObject *out_offsets) {
  const int64_t B = offsets->shape[0] - 1;
  ast_status status;
  KERNEL(*c, status, kernels->farthest_point_sample(coordinates->data, offsets->data, B, num, ints_of(out_offsets), ints_of(indices)));
  if (status == AST_OK) return Py_BuildValue("OO", indices, out_offsets);
  const int64_t scene = too_wide(coordinates->data, offsets->data, B);
  fail(c, PyExc_ValueError, "coordinates of scene %lld differ by 2^21 or more", (long long)scene);
  return NULL;
}

static PyObject *farthest_point_sample(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *coordinates, *offsets;
  int64_t samples;
  if (!start(&c, "farthest_point_sample", objects, num, 3) || !(coordinates = IN(&c, "coordinates", SMALL_INTS, 2, FREE, (int64_t)3)) ||
      !(offsets = IN(&c, "offsets", INTS, 1, FREE)) || !check_offsets(&c, offsets, coordinates->shape[0]) ||
      !take_int(&c, "num", 1, INT64_MAX, &samples))
    return NULL;
  PyObject *out_offsets = sample_offsets(offsets->data, offsets->shape[0] - 1, samples);
  PyObject *indices = out_offsets ? new_ints(ints_of(out_offsets)[offsets->shape[0] - 1]) : NULL;
  PyObject *result = indices ? sample_into(&c, coordinates, offsets, samples, indices, out_offsets) : NULL;
  Py_XDECREF(indices);
  Py_XDECREF(out_offsets);
  return result;
}

/* ---- sparse convolution ---- */

static PyObject *sparse_conv(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *x, *weight, *bias, *offsets, *source, *destination, *out;
  int64_t transposed;
  ast_status status;
  if (!start(&c, "sparse_conv", objects, num, 8) || !(x = IN(&c, "x", FLOATS, 2, FREE, FREE)) ||
      !(weight = IN(&c, "weight", FLOATS, 3, (int64_t)27, FREE, FREE)) || !(bias = IN(&c, "bias", FLOATS, 1, FREE)) ||
      !take_int(&c, "transposed", 0, 1, &transposed) || !(offsets = IN(&c, "pair_offsets", INTS, 1, (int64_t)28)) ||
      !(source = IN(&c, "source", INTS, 1, FREE)) || !(destination = IN(&c, "destination", INTS, 1, source->shape[0])) ||
      !(out = OUT(&c, "out", FLOATS, 2, FREE, weight->shape[transposed ? 1 : 2])) ||
      !check_pairs(&c, offsets, source, x->shape[0], destination, out->shape[0], true))
    return NULL;
  if (x->shape[1] != weight->shape[transposed ? 2 : 1]) {
    fail(&c, PyExc_ValueError, "x has %lld channels, weight takes %lld", (long long)x->shape[1],
         (long long)weight->shape[transposed ? 2 : 1]);
    return NULL;
  }
  if (bias->shape[0] && bias->shape[0] != out->shape[1]) {
    fail(&c, PyExc_ValueError, "bias must have shape [%lld], or [0] for none, not [%lld]", (long long)out->shape[1],
         (long long)bias->shape[0]);
    return NULL;
  }
  const ast_pairs pairs = {offsets->data, source->data, destination->data};
  KERNEL(c, status,
         kernels->sparse_conv(x->data, weight->data, bias->shape[0] ? bias->data : NULL, x->shape[1], out->shape[1], transposed, pairs,
                              out->shape[0], out->data));
  Py_RETURN_NONE;
}

static PyObject *sparse_conv_weight(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *x, *dout, *offsets, *source, *destination, *dweight;
  ast_status status;
  if (!start(&c, "sparse_conv_weight", objects, num, 6) || !(x = IN(&c, "x", FLOATS, 2, FREE, FREE)) ||
      !(dout = IN(&c, "dout", FLOATS, 2, FREE, FREE)) || !(offsets = IN(&c, "pair_offsets", INTS, 1, (int64_t)28)) ||
      !(source = IN(&c, "source", INTS, 1, FREE)) || !(destination = IN(&c, "destination", INTS, 1, source->shape[0])) ||
      !(dweight = OUT(&c, "dweight", FLOATS, 3, (int64_t)27, x->shape[1], dout->shape[1])) ||
      !check_pairs(&c, offsets, source, x->shape[0], destination, dout->shape[0], false))
    return NULL;
  const ast_pairs pairs = {offsets->data, source->data, destination->data};
  KERNEL(c, status, kernels->sparse_conv_weight(x->data, dout->data, x->shape[1], dout->shape[1], pairs, dweight->data));
  Py_RETURN_NONE;
}

/* ---- attention ---- */

static bool take_attention(call *c, ast_attention *s, argument **q, argument **k, argument **v) {
  argument *q_offsets, *k_offsets;
  double scale;
  if (!(*q = IN_ROWS(c, "q", 3, FREE, FREE, FREE)) || !(*k = IN_ROWS(c, "k", 3, FREE, (*q)->shape[1], (*q)->shape[2])) ||
      !(*v = IN_ROWS(c, "v", 3, (*k)->shape[0], (*q)->shape[1], (*q)->shape[2])) || !(q_offsets = IN(c, "q_offsets", INTS, 1, FREE)) ||
      !(k_offsets = IN(c, "k_offsets", INTS, 1, q_offsets->shape[0])) || !check_offsets(c, q_offsets, (*q)->shape[0]) ||
      !check_offsets(c, k_offsets, (*k)->shape[0]) || !take_float(c, &scale) || !take_float(c, &s->dropout_p))
    return false;
  s->seed = PyLong_AsUnsignedLongLongMask(c->objects[c->next++]);
  if (PyErr_Occurred()) return false;
  s->D = (*q)->shape[2];
  if (s->D % 16 || s->D < 16 || s->D > 128)
    return fail(c, PyExc_ValueError, "the head dimension must be a multiple of 16 up to 128, not %lld", (long long)s->D);
  if (!(s->dropout_p >= 0 && s->dropout_p < 1)) return fail(c, PyExc_ValueError, "dropout_p must lie in [0, 1)");
  s->B = q_offsets->shape[0] - 1;
  s->H = (*q)->shape[1];
  s->q_offsets = q_offsets->data;
  s->k_offsets = k_offsets->data;
  s->q_stride = (*q)->row_stride;
  s->k_stride = (*k)->row_stride;
  s->v_stride = (*v)->row_stride;
  s->scale = (float)scale;
  return true;
}

static PyObject *attention(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *q, *k, *v, *out, *maximum, *sum;
  ast_attention s;
  ast_status status;
  if (!start(&c, "attention", objects, num, 11) || !take_attention(&c, &s, &q, &k, &v) ||
      !(out = OUT(&c, "out", FLOATS, 3, q->shape[0], s.H, s.D)) || !(maximum = OUT(&c, "maximum", FLOATS, 2, q->shape[0], s.H)) ||
      !(sum = OUT(&c, "sum", FLOATS, 2, q->shape[0], s.H)))
    return NULL;
  KERNEL(c, status, kernels->attention(&s, q->data, k->data, v->data, out->data, maximum->data, sum->data));
  Py_RETURN_NONE;
}

static PyObject *attention_backward(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *q, *k, *v, *out, *maximum, *sum, *dout, *dq, *dk, *dv;
  ast_attention s;
  ast_status status;
  if (!start(&c, "attention_backward", objects, num, 15) || !take_attention(&c, &s, &q, &k, &v)) return NULL;
  const int64_t Tq = q->shape[0], Tk = k->shape[0];
  if (!(out = IN(&c, "out", FLOATS, 3, Tq, s.H, s.D)) || !(maximum = IN(&c, "maximum", FLOATS, 2, Tq, s.H)) ||
      !(sum = IN(&c, "sum", FLOATS, 2, Tq, s.H)) || !(dout = IN(&c, "dout", FLOATS, 3, Tq, s.H, s.D)) ||
      !(dq = OUT_ROWS(&c, "dq", 3, Tq, s.H, s.D)) || !(dk = OUT_ROWS(&c, "dk", 3, Tk, s.H, s.D)) ||
      !(dv = OUT_ROWS(&c, "dv", 3, Tk, s.H, s.D)))
    return NULL;
  s.dq_stride = dq->row_stride;
  s.dk_stride = dk->row_stride;
  s.dv_stride = dv->row_stride;
  KERNEL(c, status,
         kernels->attention_backward(&s, q->data, k->data, v->data, out->data, maximum->data, sum->data, dout->data, dq->data, dk->data,
                                     dv->data));
  Py_RETURN_NONE;
}

/* ---- message passing ---- */

static bool check_receivers(const call *c, const argument *receivers, const argument *offsets) {
  const int64_t *receiver = receivers->data, *offset = offsets->data;
  for (int64_t r = 0; r + 1 < offsets->shape[0]; r++)
    for (int64_t m = offset[r]; m < offset[r + 1]; m++)
      if (receiver[m] != r)
        return fail(c, PyExc_ValueError, "receivers[%lld] is %lld, but receiver_offsets say %lld", (long long)m, (long long)receiver[m],
                    (long long)r);
  return true;
}

static bool take_message(call *c, ast_message *s) {
  argument *P, *Q, *e, *A1, *a1, *A2, *W2, *b2, *gamma, *beta, *senders, *receivers, *offsets;
  if (!(P = IN(c, "of_senders", FLOATS, 2, FREE, FREE)) || !(Q = IN(c, "of_receivers", FLOATS, 2, FREE, P->shape[1])) ||
      !(e = IN(c, "edge_features", FLOATS, 2, FREE, FREE)) || !(A1 = IN(c, "A1", FLOATS, 2, FREE, e->shape[1])) ||
      !(a1 = IN(c, "a1", FLOATS, 1, A1->shape[0])) || !(A2 = IN(c, "A2", FLOATS, 2, P->shape[1], A1->shape[0])) ||
      !(W2 = IN(c, "W2", FLOATS, 2, FREE, P->shape[1])) || !(b2 = IN(c, "b2", FLOATS, 1, W2->shape[0])) ||
      !(gamma = IN(c, "gamma", FLOATS, 1, W2->shape[0])) || !(beta = IN(c, "beta", FLOATS, 1, W2->shape[0])) ||
      !(senders = IN(c, "senders", INTS, 1, e->shape[0])) || !(receivers = IN(c, "receivers", INTS, 1, e->shape[0])) ||
      !(offsets = IN(c, "receiver_offsets", INTS, 1, Q->shape[0] + 1)) || !check_offsets(c, offsets, e->shape[0]) ||
      !check_indices(c, senders, e->shape[0], P->shape[0]) || !check_receivers(c, receivers, offsets))
    return false;
  *s = (ast_message){
      .M = e->shape[0],
      .S = P->shape[0],
      .R = Q->shape[0],
      .E = e->shape[1],
      .H = A1->shape[0],
      .F = P->shape[1],
      .F2 = W2->shape[0],
      .senders = senders->data,
      .receivers = receivers->data,
      .receiver_offsets = offsets->data,
      .of_senders = P->data,
      .of_receivers = Q->data,
      .edge_features = e->data,
      .A1 = A1->data,
      .a1 = a1->data,
      .A2 = A2->data,
      .W2 = W2->data,
      .b2 = b2->data,
      .gamma = gamma->data,
      .beta = beta->data,
  };
  return true;
}

/* An array [M, width], or [0, width] where it is not given or not wanted. */
static bool check_rows(const call *c, const argument *a, int64_t M) {
  if (a->shape[0] == 0 || a->shape[0] == M) return true;
  return fail(c, PyExc_ValueError, "%s must have 0 or %lld rows, not %lld", a->name, (long long)M, (long long)a->shape[0]);
}

static PyObject *message(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *sum, *messages;
  ast_message s;
  ast_status status;
  if (!start(&c, "message", objects, num, 15) || !take_message(&c, &s) || !(sum = OUT(&c, "sum", FLOATS, 2, s.R, s.F2)) ||
      !(messages = OUT(&c, "messages", FLOATS, 2, FREE, s.F2)) || !check_rows(&c, messages, s.M))
    return NULL;
  KERNEL(c, status, kernels->message(&s, sum->data, messages->shape[0] ? messages->data : NULL));
  Py_RETURN_NONE;
}

static PyObject *message_backward(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *dsum, *dmessages, *P, *Q, *e, *A1, *a1, *A2, *W2, *b2, *gamma, *beta;
  ast_message s;
  ast_status status;
  if (!start(&c, "message_backward", objects, num, 25) || !take_message(&c, &s) || !(dsum = IN(&c, "dsum", FLOATS, 2, s.R, s.F2)) ||
      !(dmessages = IN(&c, "dmessages", FLOATS, 2, FREE, s.F2)) || !check_rows(&c, dmessages, s.M) ||
      !(P = OUT(&c, "dof_senders", FLOATS, 2, s.S, s.F)) || !(Q = OUT(&c, "dof_receivers", FLOATS, 2, s.R, s.F)) ||
      !(e = OUT(&c, "dedge_features", FLOATS, 2, FREE, s.E)) || !check_rows(&c, e, s.M) || !(A1 = OUT(&c, "dA1", FLOATS, 2, s.H, s.E)) ||
      !(a1 = OUT(&c, "da1", FLOATS, 1, s.H)) || !(A2 = OUT(&c, "dA2", FLOATS, 2, s.F, s.H)) ||
      !(W2 = OUT(&c, "dW2", FLOATS, 2, s.F2, s.F)) || !(b2 = OUT(&c, "db2", FLOATS, 1, s.F2)) ||
      !(gamma = OUT(&c, "dgamma", FLOATS, 1, s.F2)) || !(beta = OUT(&c, "dbeta", FLOATS, 1, s.F2)))
    return NULL;
  const ast_message_gradients out = {
      P->data, Q->data, e->shape[0] ? e->data : NULL, A1->data, a1->data, A2->data, W2->data, b2->data, gamma->data, beta->data,
  };
  KERNEL(c, status, kernels->message_backward(&s, dsum->data, dmessages->shape[0] ? dmessages->data : NULL, &out));
  Py_RETURN_NONE;
}

/* ---- linear ---- */

static bool check_geglu(const call *c, const ast_linear *s) {
  if (s->activation == AST_GEGLU && s->O % 2)
    return fail(c, PyExc_ValueError, "geglu takes an even number of outputs, not %lld", (long long)s->O);
  return true;
}

static PyObject *linear(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *x, *weight, *bias, *residual, *out, *z;
  int64_t activation;
  ast_status status;
  if (!start(&c, "linear", objects, num, 7) || !(x = IN_ROWS(&c, "x", 2, FREE, FREE)) ||
      !(weight = IN(&c, "weight", FLOATS, 2, FREE, x->shape[1])) || !(bias = OPTIONAL(&c, IN(&c, "bias", FLOATS, 1, weight->shape[0]))) ||
      !(residual = OPTIONAL(&c, IN_ROWS(&c, "residual", 2, x->shape[0], FREE))) ||
      !take_int(&c, "activation", AST_IDENTITY, AST_GEGLU, &activation))
    return NULL;
  const int64_t M = x->shape[0], O = weight->shape[0];
  const ast_linear s = {.M = M,
                        .I = x->shape[1],
                        .O = O,
                        .x_stride = x->row_stride,
                        .residual_stride = residual->row_stride,
                        .activation = (ast_activation)activation};
  const int64_t columns = activation == AST_GEGLU ? O / 2 : O;
  if (!check_geglu(&c, &s) || !(out = OUT(&c, "out", FLOATS, 2, M, columns)) || !(z = OPTIONAL(&c, OUT(&c, "z", FLOATS, 2, M, O))))
    return NULL;
  if (residual->data && residual->shape[1] != columns) {
    fail(&c, PyExc_ValueError, "residual must have %lld columns, not %lld", (long long)columns, (long long)residual->shape[1]);
    return NULL;
  }
  KERNEL(c, status, kernels->linear(&s, x->data, weight->data, bias->data, residual->data, out->data, z->data));
  Py_RETURN_NONE;
}

static PyObject *linear_backward(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *dout, *x, *weight, *bias, *z, *dx, *dweight, *dbias;
  int64_t activation;
  ast_status status;
  if (!start(&c, "linear_backward", objects, num, 9) || !(x = IN_ROWS(&c, "x", 2, FREE, FREE)) ||
      !(weight = IN(&c, "weight", FLOATS, 2, FREE, x->shape[1])) || !(bias = OPTIONAL(&c, IN(&c, "bias", FLOATS, 1, weight->shape[0]))) ||
      !(z = OPTIONAL(&c, IN(&c, "z", FLOATS, 2, x->shape[0], weight->shape[0]))) ||
      !take_int(&c, "activation", AST_IDENTITY, AST_GEGLU, &activation))
    return NULL;
  ast_linear s = {
      .M = x->shape[0], .I = x->shape[1], .O = weight->shape[0], .x_stride = x->row_stride, .activation = (ast_activation)activation};
  if (!check_geglu(&c, &s) || !(dout = IN_ROWS(&c, "dout", 2, s.M, activation == AST_GEGLU ? s.O / 2 : s.O)) ||
      !(dx = OPTIONAL(&c, OUT(&c, "dx", FLOATS, 2, s.M, s.I))) || !(dweight = OPTIONAL(&c, OUT(&c, "dweight", FLOATS, 2, s.O, s.I))) ||
      !(dbias = OPTIONAL(&c, OUT(&c, "dbias", FLOATS, 1, s.O))))
    return NULL;
  s.dout_stride = dout->row_stride;
  KERNEL(c, status,
         kernels->linear_backward(&s, dout->data, x->data, weight->data, bias->data, z->data, dx->data, dweight->data, dbias->data));
  Py_RETURN_NONE;
}

/* x, beside, weight1, bias1, weight2, bias2, gamma, beta */
static bool take_mlp(call *c, ast_mlp *s) {
  argument *x, *beside, *weight1, *bias1, *weight2, *bias2, *gamma, *beta;
  if (!(x = IN_ROWS(c, "x", 2, FREE, FREE)) || !(beside = OPTIONAL(c, IN_ROWS(c, "beside", 2, x->shape[0], FREE))) ||
      !(weight1 = IN(c, "weight1", FLOATS, 2, FREE, x->shape[1] + beside->shape[1])) ||
      !(bias1 = OPTIONAL(c, IN(c, "bias1", FLOATS, 1, weight1->shape[0]))) ||
      !(weight2 = IN(c, "weight2", FLOATS, 2, FREE, weight1->shape[0])) ||
      !(bias2 = OPTIONAL(c, IN(c, "bias2", FLOATS, 1, weight2->shape[0]))) ||
      !(gamma = OPTIONAL(c, IN(c, "gamma", FLOATS, 1, weight2->shape[0]))) ||
      !(beta = OPTIONAL(c, IN(c, "beta", FLOATS, 1, weight2->shape[0]))))
    return false;
  if (!gamma->data != !beta->data) return fail(c, PyExc_ValueError, "gamma and beta go together");
  *s = (ast_mlp){.M = x->shape[0],
                 .I = x->shape[1],
                 .I2 = beside->shape[1],
                 .H = weight1->shape[0],
                 .O = weight2->shape[0],
                 .x_stride = x->row_stride,
                 .beside_stride = beside->row_stride,
                 .x = x->data,
                 .beside = beside->data,
                 .weight1 = weight1->data,
                 .bias1 = bias1->data,
                 .weight2 = weight2->data,
                 .bias2 = bias2->data,
                 .gamma = gamma->data,
                 .beta = beta->data};
  return true;
}

/* What is kept between the passes, each None if it is not: h, y normalized and its factors. */
static bool take_kept(call *c, const ast_mlp *s, bool output, ast_mlp_kept *kept) {
  argument *hidden, *normalized, *scale;
  if (!(hidden = OPTIONAL(c, take(c, "hidden", FLOATS, output, false, 2, s->M, s->H))) ||
      !(normalized = OPTIONAL(c, take(c, "normalized", FLOATS, output, false, 2, s->M, s->O))) ||
      !(scale = OPTIONAL(c, take(c, "scale", FLOATS, output, false, 1, s->M))))
    return false;
  if (!normalized->data != !scale->data) return fail(c, PyExc_ValueError, "normalized and scale go together");
  *kept = (ast_mlp_kept){hidden->data, normalized->data, scale->data};
  return true;
}

static PyObject *mlp(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *residual, *out;
  ast_mlp s;
  ast_mlp_kept kept;
  ast_status status;
  if (!start(&c, "mlp", objects, num, 13) || !take_mlp(&c, &s) || !(residual = OPTIONAL(&c, IN_ROWS(&c, "residual", 2, s.M, s.O))) ||
      !(out = OUT(&c, "out", FLOATS, 2, s.M, s.O)) || !take_kept(&c, &s, true, &kept))
    return NULL;
  s.residual_stride = residual->row_stride;
  KERNEL(c, status, kernels->mlp(&s, residual->data, out->data, kept));
  Py_RETURN_NONE;
}

static PyObject *mlp_backward(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  argument *dout, *dx, *dbeside, *dweight1, *dbias1, *dweight2, *dbias2, *dgamma, *dbeta;
  ast_mlp s;
  ast_mlp_kept kept;
  ast_status status;
  if (!start(&c, "mlp_backward", objects, num, 20) || !take_mlp(&c, &s) || !(dout = IN_ROWS(&c, "dout", 2, s.M, s.O)) ||
      !take_kept(&c, &s, false, &kept) || !(dx = OPTIONAL(&c, OUT(&c, "dx", FLOATS, 2, s.M, s.I))) ||
      !(dbeside = OPTIONAL(&c, OUT(&c, "dbeside", FLOATS, 2, s.M, s.I2))) ||
      !(dweight1 = OPTIONAL(&c, OUT(&c, "dweight1", FLOATS, 2, s.H, s.I + s.I2))) ||
      !(dbias1 = OPTIONAL(&c, OUT(&c, "dbias1", FLOATS, 1, s.H))) || !(dweight2 = OPTIONAL(&c, OUT(&c, "dweight2", FLOATS, 2, s.O, s.H))) ||
      !(dbias2 = OPTIONAL(&c, OUT(&c, "dbias2", FLOATS, 1, s.O))) || !(dgamma = OPTIONAL(&c, OUT(&c, "dgamma", FLOATS, 1, s.O))) ||
      !(dbeta = OPTIONAL(&c, OUT(&c, "dbeta", FLOATS, 1, s.O))))
    return NULL;
  s.dout_stride = dout->row_stride;
  const ast_mlp_gradients gradients = {dx->data,       dbeside->data, dweight1->data, dbias1->data,
                                       dweight2->data, dbias2->data,  dgamma->data,   dbeta->data};
  KERNEL(c, status, kernels->mlp_backward(&s, dout->data, kept, gradients));
  Py_RETURN_NONE;
}

/* ---- the process ---- */

/* The addresses of torch_parallel_for and torch_get_num_threads. */
static PyObject *set_pool(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  if (!start(&c, "set_pool", objects, num, 2)) return NULL;
  const uintptr_t parallel_for = (uintptr_t)PyLong_AsUnsignedLongLong(objects[0]);
  const uintptr_t num_threads = (uintptr_t)PyLong_AsUnsignedLongLong(objects[1]);
  if (PyErr_Occurred()) return NULL;
  ast_set_pool((ast_parallel_for)parallel_for, (ast_num_threads)num_threads);
  Py_RETURN_NONE;
}

static PyObject *keep_memory(PyObject *self, PyObject *unused) {
  (void)self, (void)unused;
  return PyBool_FromLong(ast_keep_memory());
}

static PyObject *configuration(PyObject *self, PyObject *unused) {
  (void)self, (void)unused;
  static const char *const names[] = {"base", "avx2", "avx512"};
  PyObject *supported = PyList_New(0);
  for (int i = 0; supported && i < 3; i++) {
    if (!ast_select(names[i])) continue;
    PyObject *name = PyUnicode_FromString(names[i]);
    if (!name || PyList_Append(supported, name)) Py_CLEAR(supported);
    Py_XDECREF(name);
  }
  if (!supported) return NULL;
  return Py_BuildValue("{s:s,s:N,s:L,s:O}", "isa", kernels->isa, "supported", supported, "threads", (long long)ast_threads(), "debug",
                       debug ? Py_True : Py_False);
}

#define FAST(name, text) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, text}

static PyMethodDef methods[] = {
    FAST(segment_sum, "segment_sum(x, node_order, node_offsets, mean, out)"),
    FAST(segment_spread, "segment_spread(dout, node_order, node_offsets, mean, dx)"),
    FAST(octree_build,
         "octree_build(positions, offsets, cx, cy, cz, half_width, depth, keys, cell_offsets, node_cell, node_order, "
         "node_offsets)"),
    FAST(octree_coordinates, "octree_coordinates(keys, coordinates)"),
    FAST(octree_coarsen, "octree_coarsen(keys, cell_offsets, levels) -> list of nine arrays a level"),
    FAST(farthest_point_sample, "farthest_point_sample(coordinates, offsets, num) -> (indices, out_offsets)"),
    FAST(sparse_conv, "sparse_conv(x, weight, bias, transposed, pair_offsets, source, destination, out)"),
    FAST(sparse_conv_weight, "sparse_conv_weight(x, dout, pair_offsets, source, destination, dweight)"),
    FAST(attention, "attention(q, k, v, q_offsets, k_offsets, scale, dropout_p, seed, out, maximum, sum)"),
    FAST(attention_backward,
         "attention_backward(q, k, v, q_offsets, k_offsets, scale, dropout_p, seed, out, maximum, sum, dout, dq, "
         "dk, dv)"),
    FAST(message,
         "message(of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, receiver_offsets, "
         "sum, messages)"),
    FAST(message_backward,
         "message_backward(of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, "
         "receiver_offsets, dsum, dmessages, then the gradients in the order of the inputs)"),
    FAST(linear, "linear(x, weight, bias, residual, activation, out, z); bias, residual and z may be None"),
    FAST(linear_backward,
         "linear_backward(x, weight, bias, z, activation, dout, dx, dweight, dbias); bias, z and the gradients that are not wanted may be "
         "None"),
    FAST(column_sum, "column_sum(x, out)"),
    FAST(mlp,
         "mlp(x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual, out, hidden, normalized, scale); all but x, the weights "
         "and out may be None"),
    FAST(mlp_backward,
         "mlp_backward(x, beside, weight1, bias1, weight2, bias2, gamma, beta, dout, hidden, normalized, scale, dx, dbeside, dweight1, "
         "dbias1, dweight2, dbias2, dgamma, dbeta); all but x, the weights and dout may be None"),
    FAST(set_pool, "set_pool(parallel_for, num_threads): addresses of torch's thread pool, 0 for serial"),
    {"keep_memory", keep_memory, METH_NOARGS, "Let the C library keep freed blocks; whether it had an effect."},
    {"configuration", configuration, METH_NOARGS, "The chosen instruction set, the supported ones, the threads, the debug mode."},
    {NULL, NULL, 0, NULL},
};

static int execute(PyObject *module) {
  (void)module;
  import_array1(-1);
  const char *wanted = getenv("AST_SIM_ISA"), *check = getenv("AST_SIM_DEBUG");
  debug = check && !strcmp(check, "1");
  kernels = ast_select(wanted && *wanted ? wanted : NULL);
  if (kernels) return 0;
  PyErr_Format(PyExc_ImportError, "AST_SIM_ISA=%s is not supported by this processor and build; unset it or choose base, avx2 or avx512",
               wanted);
  return -1;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, execute}, {0, NULL}};

static struct PyModuleDef definition = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "_C",
    .m_doc = "The C core of ast_sim. Use ast_sim.ops instead.",
    .m_methods = methods,
    .m_slots = slots,
};

PyMODINIT_FUNC PyInit__C(void) { return PyModuleDef_Init(&definition); }
