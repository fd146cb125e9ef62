/* How the module takes its arguments apart: every array is checked for type, shape, layout and index range before a kernel sees it.
 *
 * Arrays are NumPy arrays or tensors (view.h) of exact dtype, aligned and row major; outputs are allocated by the caller. A message
 * names the op, the argument and the offending value. In debug mode outputs are filled with NaN (integers: -1) before the kernel
 * runs, and inputs are compared with copies afterwards. Included by module.c and its module_*.h alone.
 */
#ifndef AST_ARGUMENTS_H
#define AST_ARGUMENTS_H

#include "view.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#undef I /* of complex.h, which NumPy includes: here it is a number of inputs */
#include "ast.h"

static const ast_kernels *kernels; /* of the chosen instruction set */
static bool debug;                 /* AST_SIM_DEBUG=1 */

/* ---- arguments ---- */

enum { MAX_ARRAYS = 28, ANY = -1 };

typedef struct {
  const char *name;
  void *data;
  int64_t shape[MAX_SHAPE];
  int64_t row_stride; /* in items */
  bool output;
  size_t bytes, row_bytes; /* of all elements, and from row to row */
  bool dense;
  void *copy; /* debug: what an input held before the call */
} argument;

typedef struct {
  const char *op;
  PyObject *const *objects;
  int next;
  argument arrays[MAX_ARRAYS];
  int num_arrays;
} call;

static bool start(call *c, const char *op, PyObject *const *objects, Py_ssize_t num, int arity) {
  *c = (call){.op = op, .objects = objects};
  if (num == arity) return true;
  PyErr_Format(PyExc_TypeError, "%s takes %d arguments, not %zd", op, arity, num);
  return false;
}

static bool fail(const call *c, PyObject *type, const char *format, ...) {
  va_list values;
  va_start(values, format);
  PyObject *text = PyUnicode_FromFormatV(format, values);
  va_end(values);
  if (text) PyErr_Format(type, "%s: %U", c->op, text);
  Py_XDECREF(text);
  return false;
}

static const char *type_name(int type) { return type == FLOATS ? "float32" : type == INTS ? "int64" : "int32"; }

/* Rows may lie apart if `strided_rows`. */
static bool check_layout(const call *c, argument *a, const view *v, bool strided_rows) {
  const int64_t size = view_size(v);
  int64_t expected = v->item;
  if (!v->native) return fail(c, PyExc_ValueError, "%s must be aligned and in native byte order", a->name);
  a->dense = true;
  for (int d = v->ndim - 1; d >= 0; d--) {
    const int64_t stride = v->stride[d];
    if (size && v->shape[d] > 1 && stride != expected) {
      if (!strided_rows || d > 0 || stride < expected || stride % v->item)
        return fail(c, PyExc_ValueError, "%s must be contiguous", a->name);
      a->dense = false;
    }
    if (d == 0) a->row_bytes = (size_t)(v->shape[0] > 1 ? stride : expected);
    expected *= v->shape[d];
  }
  a->bytes = (size_t)(size * v->item);
  a->row_stride = (int64_t)a->row_bytes / v->item;
  return true;
}

/* The message of an argument that is `wanted`, and not as this attribute of it says. */
static bool fail_attribute(const call *c, PyObject *type, const char *name, const char *wanted, PyObject *object, const char *attribute) {
  PyObject *value = PyObject_GetAttrString(object, attribute);
  PyObject *shown = value && strcmp(attribute, "shape") == 0 ? PySequence_Tuple(value) : value;
  if (shown) fail(c, type, "%s must %s, not %R", name, wanted, shown);
  if (shown != value) Py_XDECREF(shown);
  Py_XDECREF(value);
  return false;
}

static bool fail_shape(const call *c, const char *name, PyObject *object, int ndim, va_list lengths) {
  char wanted[120] = "have shape [";
  for (int d = 0; d < ndim; d++) {
    const int64_t length = va_arg(lengths, int64_t);
    const size_t used = strlen(wanted);
    if (length == ANY) snprintf(wanted + used, sizeof wanted - used, "%s*", d ? ", " : "");
    else snprintf(wanted + used, sizeof wanted - used, "%s%lld", d ? ", " : "", (long long)length);
  }
  strncat(wanted, "]", sizeof wanted - strlen(wanted) - 1);
  return fail_attribute(c, PyExc_ValueError, name, wanted, object, "shape");
}

/* The next argument as an array of this type and shape; ANY lengths are free. NULL if it does not fit. */
static argument *take(call *c, const char *name, int type, bool output, bool strided_rows, int ndim, ...) {
  PyObject *object = c->objects[c->next++];
  argument *a = &c->arrays[c->num_arrays];
  view v;
  *a = (argument){.name = name, .output = output};
  if (!view_of(object, &v)) {
    fail(c, PyExc_TypeError, "%s must be a NumPy array or a dense tensor on the CPU, not %R", name, (PyObject *)Py_TYPE(object));
    return NULL;
  }
  if (v.type != type) {
    char wanted[16];
    snprintf(wanted, sizeof wanted, "be %s", type_name(type));
    fail_attribute(c, PyExc_TypeError, name, wanted, object, "dtype");
    return NULL;
  }
  va_list lengths;
  va_start(lengths, ndim);
  bool fits = v.ndim == ndim;
  for (int d = 0; fits && d < ndim; d++) {
    const int64_t length = va_arg(lengths, int64_t);
    a->shape[d] = v.shape[d];
    fits = length == ANY || length == a->shape[d];
  }
  va_end(lengths);
  if (!fits) {
    va_start(lengths, ndim);
    fail_shape(c, name, object, ndim, lengths);
    va_end(lengths);
    return NULL;
  }
  if (output && !v.writeable) {
    fail(c, PyExc_ValueError, "%s must be writeable", name);
    return NULL;
  }
  if (!check_layout(c, a, &v, strided_rows)) return NULL;
  a->data = v.data;
  c->num_arrays++;
  return a;
}

#define IN(c, name, type, ndim, ...)  take(c, name, type, false, false, ndim, __VA_ARGS__)
#define IN_ROWS(c, name, ndim, ...)   take(c, name, FLOATS, false, true, ndim, __VA_ARGS__)
#define OUT(c, name, type, ndim, ...) take(c, name, type, true, false, ndim, __VA_ARGS__)
#define OUT_ROWS(c, name, ndim, ...)  take(c, name, FLOATS, true, true, ndim, __VA_ARGS__)
#define FREE                          ((int64_t)ANY)

/* The argument that `expression` takes, or one without data where None is given. */
static argument absent;
#define OPTIONAL(c, expression) ((c)->objects[(c)->next] == Py_None ? ((c)->next++, &absent) : (expression))

/* An integer too large for C is out of range like any other; so is a float. */
static bool too_large(call *c, const char *name, PyObject *object) {
  if (!PyErr_ExceptionMatches(PyExc_OverflowError)) return false;
  PyErr_Clear();
  return fail(c, PyExc_ValueError, "%s must not be as large as %R", name, object);
}

static bool take_int(call *c, const char *name, int64_t low, int64_t high, int64_t *out) {
  PyObject *object = c->objects[c->next++];
  *out = PyLong_AsLongLong(object);
  if (*out == -1 && PyErr_Occurred()) return too_large(c, name, object);
  if (*out < low || *out > high)
    return fail(c, PyExc_ValueError, "%s must lie in %lld..%lld, not %lld", name, (long long)low, (long long)high, (long long)*out);
  return true;
}

static bool take_float(call *c, double *out) {
  PyObject *object = c->objects[c->next++];
  *out = PyFloat_AsDouble(object);
  if (*out == -1 && PyErr_Occurred()) return too_large(c, "a number", object);
  return true;
}

static bool check_offsets(const call *c, const argument *a, int64_t rows) {
  const int64_t *offsets = a->data, n = a->shape[0];
  if (n < 1 || offsets[0] != 0) return fail(c, PyExc_ValueError, "%s must start with 0", a->name);
  for (int64_t i = 1; i < n; i++)
    if (offsets[i] < offsets[i - 1])
      return fail(c, PyExc_ValueError, "%s must never fall, but falls to %lld at %lld", a->name, (long long)offsets[i], (long long)i);
  if (offsets[n - 1] != rows)
    return fail(c, PyExc_ValueError, "%s must end at the number of rows %lld, not %lld", a->name, (long long)rows,
                (long long)offsets[n - 1]);
  return true;
}

static bool check_indices(const call *c, const argument *a, int64_t length, int64_t bound) {
  const int64_t *index = a->data;
  for (int64_t i = 0; i < length; i++)
    if (index[i] < 0 || index[i] >= bound)
      return fail(c, PyExc_ValueError, "%s[%lld] = %lld is not an index below %lld", a->name, (long long)i, (long long)index[i],
                  (long long)bound);
  return true;
}

static bool check_permutation(const call *c, const argument *a, int64_t n) {
  if (!check_indices(c, a, n, n)) return false;
  const int64_t *index = a->data;
  AST_SCRATCH_SCOPE;
  uint8_t *seen = ast_scratch(n / 8 + 1);
  if (!seen) return PyErr_NoMemory(), false;
  memset(seen, 0, (size_t)(n / 8 + 1));
  for (int64_t i = 0; i < n; i++) {
    const uint8_t bit = (uint8_t)(1u << (index[i] & 7));
    if (seen[index[i] >> 3] & bit)
      return fail(c, PyExc_ValueError, "%s must be a permutation, but holds %lld twice", a->name, (long long)index[i]);
    seen[index[i] >> 3] |= bit;
  }
  return true;
}

/* Group k of the pairs is offsets[k]..offsets[k+1]; destinations rise strictly within it. */
static bool check_pairs(const call *c, const argument *offsets, const argument *source, int64_t sources, const argument *destination,
                        int64_t destinations, bool rising) {
  if (!check_offsets(c, offsets, source->shape[0]) || !check_indices(c, source, source->shape[0], sources) ||
      !check_indices(c, destination, destination->shape[0], destinations))
    return false;
  const int64_t *offset = offsets->data, *index = destination->data;
  for (int64_t k = 0; rising && k < 27; k++)
    for (int64_t i = offset[k] + 1; i < offset[k + 1]; i++)
      if (index[i] <= index[i - 1])
        return fail(c, PyExc_ValueError, "%s must rise strictly within each kernel offset, but does not at %lld", destination->name,
                    (long long)i);
  return true;
}

/* ---- around a kernel ---- */

static bool begin(call *c) {
  for (int i = 0; debug && i < c->num_arrays; i++) {
    argument *a = &c->arrays[i];
    if (a->output) { /* all bits set: NaN, and -1 as an integer */
      const size_t rows = a->bytes ? (size_t)a->shape[0] : 0;
      for (size_t row = 0; row < rows; row++) memset((char *)a->data + row * a->row_bytes, 0xff, a->bytes / rows);
    } else if (a->bytes && a->dense) {
      if (!(a->copy = malloc(a->bytes))) return PyErr_NoMemory(), false;
      memcpy(a->copy, a->data, a->bytes);
    }
  }
  return true;
}

static bool end(call *c, ast_status status) {
  bool ok = !PyErr_Occurred();
  for (int i = 0; i < c->num_arrays; i++) {
    argument *a = &c->arrays[i];
    if (!a->copy) continue;
    if (ok && memcmp(a->copy, a->data, a->bytes)) ok = fail(c, PyExc_AssertionError, "the kernel changed its input %s", a->name);
    free(a->copy);
  }
  if (ok && status == AST_NO_MEMORY) return PyErr_NoMemory(), false;
  return ok;
}

/* Runs `expression` without the GIL between the two; leaves the function if anything failed. */
#define KERNEL(c, status, expression)      \
  do {                                     \
    (status) = AST_OK;                     \
    if (begin(&(c))) {                     \
      Py_BEGIN_ALLOW_THREADS;              \
      (status) = (expression);             \
      Py_END_ALLOW_THREADS;                \
    }                                      \
    if (!end(&(c), (status))) return NULL; \
  } while (0)

#endif
