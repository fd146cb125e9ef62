/* The module's functions of points and cells: segment sums, elastic forces, octree, sampling, sparse convolution. Included by module.c
 * alone.*/
#ifndef AST_MODULE_CELLS_H
#define AST_MODULE_CELLS_H

#include "arguments.h"

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

/* ---- elastic forces ---- */

/* Each corner stands once, at its node, and the corners of a node rise: so the elements hold indices of nodes. Where they do not, that is
 * what the message says. Without branches: this takes place in every call. */
static bool check_corners(const call *c, const argument *elements, const argument *order, const argument *offsets) {
  const int64_t *node = elements->data, *corner = order->data, *offset = offsets->data, corners = order->shape[0];
  if (!check_offsets(c, offsets, corners)) return false;
  for (int64_t n = 0; n + 1 < offsets->shape[0]; n++) {
    bool wrong = false;
    for (int64_t j = offset[n]; j < offset[n + 1]; j++) {
      const bool inside = (uint64_t)corner[j] < (uint64_t)corners, rises = j == offset[n] || corner[j] > corner[j - 1];
      wrong |= !inside | !rises | (node[inside ? corner[j] : 0] != n);
    }
    if (wrong)
      return check_indices(c, elements, corners, offsets->shape[0] - 1) &&
             fail(c, PyExc_ValueError, "node_order[%lld:%lld] must be the corners of elements at node %lld, ascending",
                  (long long)offset[n], (long long)offset[n + 1], (long long)n);
  }
  return true;
}

static bool take_elastic(call *c, ast_elastic *s) {
  argument *position, *rest, *lame, *elements, *order, *offsets;
  if (!(position = IN(c, "position", FLOATS, 2, FREE, (int64_t)3)) ||
      !(rest = IN(c, "rest_position", FLOATS, 2, position->shape[0], (int64_t)3)) || !(lame = IN(c, "lame", FLOATS, 2, FREE, (int64_t)2)) ||
      !(elements = IN(c, "elements", INTS, 2, lame->shape[0], (int64_t)4)) || !(order = IN(c, "node_order", INTS, 1, 4 * lame->shape[0])) ||
      !(offsets = IN(c, "node_offsets", INTS, 1, position->shape[0] + 1)) || !check_corners(c, elements, order, offsets))
    return false;
  *s = (ast_elastic){
      position->shape[0], lame->shape[0], elements->data, order->data, offsets->data, position->data, rest->data, lame->data,
  };
  return true;
}

static PyObject *elastic_forces(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  ast_elastic s;
  argument *force;
  ast_status status;
  if (!start(&c, "elastic_forces", objects, num, 7) || !take_elastic(&c, &s) || !(force = OUT(&c, "force", FLOATS, 2, s.N, (int64_t)3)))
    return NULL;
  KERNEL(c, status, kernels->elastic_forces(&s, force->data));
  Py_RETURN_NONE;
}

static PyObject *elastic_forces_backward(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  call c;
  ast_elastic s;
  argument *dforce, *dposition;
  ast_status status;
  if (!start(&c, "elastic_forces_backward", objects, num, 8) || !(dforce = IN(&c, "dforce", FLOATS, 2, FREE, (int64_t)3)) ||
      !take_elastic(&c, &s))
    return NULL;
  if (dforce->shape[0] != s.N) {
    fail(&c, PyExc_ValueError, "dforce must have shape [%lld, 3], not [%lld, 3]", (long long)s.N, (long long)dforce->shape[0]);
    return NULL;
  }
  if (!(dposition = OUT(&c, "dposition", FLOATS, 2, s.N, (int64_t)3))) return NULL;
  KERNEL(c, status, kernels->elastic_forces_backward(&s, dforce->data, dposition->data));
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
 * code runs in between. */
static PyObject *fill_levels(call *c, const argument *keys, const argument *offsets, int levels, PyObject *list) {
  AST_SCRATCH_SCOPE; /* of the levels */
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

#endif
