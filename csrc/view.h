/* What the module reads of a tensor that Python holds, of a library that offers DLPack's exchange in C.
 *
 * A torch tensor is looked at where it lies, by one C call and without a Python object beside it; torch has offered
 * this since 2.10 (`__dlpack_c_exchange_api__`, DLPack 1.3). Nothing is owned: a view is good while the caller holds
 * the object. Included by arguments.h alone.
 */
#ifndef AST_VIEW_H
#define AST_VIEW_H

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#define NPY_TARGET_VERSION    NPY_1_23_API_VERSION
#include <numpy/arrayobject.h>
#include <stdbool.h>
#include <stdint.h>

enum { FLOATS = NPY_FLOAT32, INTS = NPY_INT64, SMALL_INTS = NPY_INT32, OTHER_TYPE = -1 };
enum { MAX_SHAPE = 4 };

typedef struct {
  void *data; /* never NULL */
  int type, ndim;
  int64_t item;                                /* bytes */
  int64_t shape[MAX_SHAPE], stride[MAX_SHAPE]; /* strides in bytes; unset where ndim is larger than MAX_SHAPE */
  bool aligned;
} view;

static int64_t view_size(const view *v) {
  int64_t size = 1;
  for (int d = 0; d < v->ndim; d++) size *= v->shape[d];
  return size;
}

static char nothing[64]; /* where arrays without elements lie */

/* ---- the part of DLPack's interface (dlpack.h, version 1) that takes a look at a tensor ---- */

enum { DLPACK_CPU = 1, DLPACK_INT = 0, DLPACK_FLOAT = 2 };

typedef struct {
  void *data;
  int32_t device_type, device_id, ndim;
  uint8_t code, bits;
  uint16_t lanes;
  int64_t *shape, *strides; /* in items */
  uint64_t byte_offset;
} dlpack_tensor;

typedef struct {
  uint32_t major, minor;
  const void *previous, *allocate, *from_object, *to_object;
  int (*look)(void *object, dlpack_tensor *tensor); /* 0, or an exception is set; may be NULL */
  const void *stream;
} dlpack_exchange;

/* The exchange of a type and of types derived from it, kept from call to call; NULL for what is no tensor. */
static const dlpack_exchange *view_exchange(PyTypeObject *type) {
  static PyTypeObject *known;
  static const dlpack_exchange *exchange;
  if (known && PyType_IsSubtype(type, known)) return exchange;
  PyObject *capsule = PyObject_GetAttrString((PyObject *)type, "__dlpack_c_exchange_api__");
  const dlpack_exchange *found = capsule ? PyCapsule_GetPointer(capsule, "dlpack_exchange_api") : NULL;
  Py_XDECREF(capsule);
  PyErr_Clear();
  if (!found || found->major != 1 || !found->look) return NULL;
  Py_INCREF((PyObject *)type);
  Py_XDECREF((PyObject *)known);
  known = type;
  return exchange = found;
}

static int view_type(const dlpack_tensor *t) {
  if (t->lanes != 1) return OTHER_TYPE;
  if (t->code == DLPACK_FLOAT && t->bits == 32) return FLOATS;
  if (t->code == DLPACK_INT && t->bits == 64) return INTS;
  if (t->code == DLPACK_INT && t->bits == 32) return SMALL_INTS;
  return OTHER_TYPE;
}

/* Whether the object is a strided tensor in this machine's memory. */
static bool view_of(PyObject *object, view *v) {
  const dlpack_exchange *exchange = view_exchange(Py_TYPE(object));
  dlpack_tensor t;
  if (!exchange) return false;
  if (exchange->look(object, &t) != 0) return PyErr_Clear(), false;
  if (t.device_type != DLPACK_CPU) return false;
  const int64_t item = (t.bits * t.lanes + 7) / 8;
  char *data = t.data ? (char *)t.data + t.byte_offset : nothing;
  *v = (view){.data = data,
              .type = view_type(&t),
              .ndim = t.ndim,
              .item = item,
              .aligned = item && (uintptr_t)data % (uintptr_t)item == 0};
  bool empty = false;
  for (int d = 0; d < v->ndim; d++) empty = empty || t.shape[d] == 0;
  for (int d = 0; d < v->ndim && d < MAX_SHAPE; d++) v->shape[d] = t.shape[d], v->stride[d] = t.strides[d] * item;
  return t.data || empty;
}

#endif
