/* How the module takes its arguments apart: every array is checked for type, shape, layout and index range before a
 * kernel sees it.
 *
 * What a kernel takes stands in its spec (spec.h). Arrays are tensors (view.h) of exact dtype, aligned and row major;
 * outputs are allocated by the caller, unless the kernel counts them. A message here names the kernel and the argument.
 * Which value is wrong, and what would be right, ast_sim/ops/spec.py finds out, whose checks are the same. A
 * BufferError means that a copy in row major order will do. In debug mode outputs are filled with NaN (integers: -1)
 * before the kernel runs, and inputs are compared with copies afterwards. Included by module_kernels.h alone.
 */
#ifndef AST_ARGUMENTS_H
#define AST_ARGUMENTS_H

#include "frozen.h"

#undef I /* of complex.h, which NumPy includes: here it is a number of inputs */
#include "ast.h"

static const ast_kernels *float32_kernels; /* of the chosen instruction set */
static ast_kernels bfloat16_kernels;       /* the same, but for products in bfloat16; without a name: there are none */
static _Thread_local bool bfloat16_products; /* whether this thread wants them */
static bool debug;                           /* AST_SIM_DEBUG=1 */

static const ast_kernels *call_table(void) { return bfloat16_products ? &bfloat16_kernels : float32_kernels; }

typedef struct {
  void *data;                 /* NULL where None was given */
  int64_t length, row_stride; /* rows, and items from row to row */
  int64_t integer;            /* also a number's 64 bits */
  double number;
  int64_t bytes, row_bytes; /* of all elements, and from row to row */
  bool contiguous;
  frozen *frozen; /* whose private copy `data` is, or where an output is made; held during the call; or NULL */
  void *secured;  /* or a copy made for this call */
  void *copy;     /* debug: what an input held before the call */
} argument;

typedef struct {
  const spec *spec;
  int64_t size[LETTERS]; /* by letter; UNBOUND before first sight */
  argument arguments[MAX_PARAMETERS];
} call;

enum { UNBOUND = -1 };

static bool call_fail(const call *c, const char *problem) {
  PyErr_Format(PyExc_ValueError, "%s: %s", c->spec->name, problem);
  return false;
}

/* The name of an argument; good until the next call. */
static const char *call_name_of(const call *c, int i) {
  static char shown[80];
  const char *name = c->spec->names;
  while (i--) name = strchr(name, ' ') + 1;
  snprintf(shown, sizeof shown, "%.*s", (int)strcspn(name, ","), name);
  return shown;
}

static bool call_refuse(const call *c, int i, PyObject *type, const char *why) {
  PyErr_Format(type, "%s: %s %s", c->spec->name, call_name_of(c, i), why);
  return false;
}

/* ---- dimensions ---- */

static int64_t call_value_of(const call *c, const dimension *d) {
  int64_t value = d->constant;
  for (int i = 0; i < 2; i++) {
    const int64_t size = c->size[d->letter[i]];
    if (size != UNBOUND) value += d->factor[i] * size;
  }
  return value;
}

/* Whether an axis may be as long as this. A letter that stands alone binds at first sight; in a sum an absent one is
 * 0. */
static bool call_fits(call *c, const dimension *d, int64_t length) {
  int64_t *size = &c->size[d->letter[0]];
  if (*size == UNBOUND && !d->letter[1]) {
    const int64_t rest = length - d->constant;
    if (rest < 0 || rest % d->factor[0]) return false;
    *size = rest / d->factor[0];
  }
  return length == call_value_of(c, d);
}

/* ---- arrays and numbers ---- */

static bool call_take_shape(call *c, const parameter *p, const view *v) {
  bool right = v->ndim == p->ndim;
  for (int d = 0; right && d < p->ndim; d++) right = call_fits(c, &p->shape[d], v->shape[d]);
  return right;
}

static bool argument_take_layout(const parameter *p, const view *v, argument *a) {
  const int64_t size = view_size(v);
  int64_t expected = v->item;
  a->contiguous = true;
  for (int d = v->ndim - 1; d >= 0; d--) {
    const int64_t stride = v->stride[d];
    if (size && v->shape[d] > 1 && stride != expected) {
      if (!p->rows_apart || d > 0 || stride < expected || stride % v->item) return false;
      a->contiguous = false;
    }
    if (d == 0) a->row_bytes = v->shape[0] > 1 ? stride : expected;
    expected *= v->shape[d];
  }
  a->data = v->data;
  a->length = v->shape[0];
  a->bytes = size * v->item;
  a->row_stride = a->row_bytes / v->item;
  return v->aligned;
}

static bool call_take_array(call *c, int i, PyObject *object) {
  const parameter *p = &c->spec->parameters[i];
  view v;
  if (!view_of(object, &v)) return call_refuse(c, i, PyExc_TypeError, "must be a strided tensor on the CPU");
  if (v.type != p->type) return call_refuse(c, i, PyExc_ValueError, "is of another type");
  if (!call_take_shape(c, p, &v)) return call_refuse(c, i, PyExc_ValueError, "has another shape");
  if (p->filled && view_size(&v) == 0) return call_refuse(c, i, PyExc_ValueError, "has no elements");
  return argument_take_layout(p, &v, &c->arguments[i]) ||
         call_refuse(c, i, PyExc_BufferError, "must be aligned and contiguous");
}

static bool call_take_number(call *c, int i, PyObject *object) {
  const parameter *p = &c->spec->parameters[i];
  argument *a = &c->arguments[i];
  if (p->kind == NUMBER) a->number = PyFloat_AsDouble(object);
  else if (p->kind == BITS) a->integer = (int64_t)PyLong_AsUnsignedLongLongMask(object);
  else a->integer = PyLong_AsLongLong(object);
  bool inside = true;
  if ((a->number == -1 || a->integer == -1) && PyErr_Occurred()) {
    if (!PyErr_ExceptionMatches(PyExc_OverflowError)) return false;
    PyErr_Clear();
    inside = false;
  }
  if (p->kind == INTEGER) inside &= a->integer >= p->low && a->integer <= p->high;
  if (p->kind == NUMBER && p->low < p->high) inside &= a->number >= (double)p->low && a->number < (double)p->high;
  if (p->shape[0].letter[0]) c->size[p->shape[0].letter[0]] = a->integer;
  return inside || call_refuse(c, i, PyExc_ValueError, "is out of range");
}

/* ---- values: `a` is the array with the check, `bound` the dimension that the spec names, `others` the arrays ---- */

#define UNUSED __attribute__((unused))
#define CHECK(name) \
  static bool check_##name(const argument *a, UNUSED int64_t bound, UNUSED const argument *const others[2])

/* They start with 0, never fall and end at the bound. */
CHECK(offsets) {
  const int64_t *offsets = a->data, n = a->length;
  if (n < 1 || offsets[0] != 0) return false;
  for (int64_t i = 1; i < n; i++)
    if (offsets[i] < offsets[i - 1]) return false;
  return offsets[n - 1] == bound;
}

CHECK(index) {
  const int64_t *index = a->data, n = a->bytes / (int64_t)sizeof *index;
  for (int64_t i = 0; i < n; i++)
    if (index[i] < 0 || index[i] >= bound) return false;
  return true;
}

CHECK(permutation) {
  const int64_t *index = a->data, n = a->length;
  if (!check_index(a, n, others)) return false;
  uint8_t *seen = calloc((size_t)n / 8 + 1, 1);
  if (!seen) return PyErr_NoMemory(), false;
  bool once = true;
  for (int64_t i = 0; i < n; i++) {
    const uint8_t bit = (uint8_t)(1u << (index[i] & 7));
    if (seen[index[i] >> 3] & bit) once = false;
    seen[index[i] >> 3] |= bit;
  }
  free(seen);
  return once;
}

/* Strictly within each group of pairs; the other array are the offsets of the groups. */
CHECK(rising) {
  const int64_t *offset = others[0]->data, *index = a->data;
  for (int64_t k = 0; k + 1 < others[0]->length; k++)
    for (int64_t i = offset[k] + 1; i < offset[k + 1]; i++)
      if (index[i] <= index[i - 1]) return false;
  return true;
}

/* The other array are the keys of the cells: at least 0, and strictly rising within each scene. */
CHECK(scenes) {
  const int64_t *key = others[0]->data, *offset = a->data;
  for (int64_t b = 0; b + 1 < a->length; b++)
    for (int64_t i = offset[b]; i < offset[b + 1]; i++)
      if (key[i] < 0 || (i > offset[b] && key[i] <= key[i - 1])) return false;
  return true;
}

/* The other array holds the number of the segment of each row. */
CHECK(segments) {
  const int64_t *segment = others[0]->data, *offset = a->data;
  for (int64_t r = 0; r + 1 < a->length; r++)
    for (int64_t m = offset[r]; m < offset[r + 1]; m++)
      if (segment[m] != r) return false;
  return true;
}

/* The others are elements and the order of their corners. Each corner stands once, at its node, and the corners of a
 * node rise: so the elements hold indices of nodes. */
CHECK(corners) {
  const int64_t *node = others[0]->data, *corner = others[1]->data, *offset = a->data, corners = others[1]->length;
  bool wrong = false; /* without branches */
  for (int64_t n = 0; n + 1 < a->length; n++)
    for (int64_t j = offset[n]; j < offset[n + 1]; j++) {
      const bool inside = (uint64_t)corner[j] < (uint64_t)corners, rises = j == offset[n] || corner[j] > corner[j - 1];
      wrong |= !inside | !rises | (node[inside ? corner[j] : 0] != n);
    }
  return !wrong;
}

/* All of them, and their names in the same order: a spec says them by number. */
static bool (*const checks[])(const argument *, int64_t, const argument *const[2]) = {
    check_offsets, check_index, check_permutation, check_rising, check_scenes, check_segments, check_corners};
static const char check_names[] = "offsets index permutation rising scenes segments corners";

/* Copies integers to where no other thread can change them (frozen.h): all checks and the kernel read them there. */
static bool argument_secure(argument *a) {
  if (!a->bytes) return true;
  if ((a->frozen = frozen_find(a->data, a->bytes))) Py_INCREF(a->frozen->owner);
  void **copy = a->frozen ? &a->frozen->copied : &a->secured;
  if (!*copy) {
    if (!(*copy = malloc((size_t)a->bytes))) return PyErr_NoMemory(), false;
    memcpy(*copy, a->data, (size_t)a->bytes);
  }
  a->data = *copy;
  return true;
}

static void call_release(call *c) {
  for (int i = 0; i < c->spec->num; i++) {
    if (c->arguments[i].frozen) Py_DECREF(c->arguments[i].frozen->owner);
    free(c->arguments[i].secured);
  }
}

static bool check_values(const call *c, int at) {
  const parameter *p = &c->spec->parameters[at];
  const argument *a = &c->arguments[at];
  for (int i = 0; i < p->num_checks; i++) {
    const value_check *check = &p->checks[i];
    const argument *others[2];
    fact found = {check->check, call_value_of(c, &check->bound), {0, 0}};
    bool lasts = a->frozen;
    for (int j = 0; j < 2; j++) {
      others[j] = check->others[j] == NO_PARAMETER ? NULL : &c->arguments[check->others[j]];
      if (others[j] && others[j]->frozen) found.others[j] = others[j]->frozen->number;
      else if (others[j]) lasts = false;
    }
    if (lasts && frozen_knows(a->frozen, &found)) continue;
    if (!checks[check->check](a, found.bound, others))
      return PyErr_Occurred() ? false : call_refuse(c, at, PyExc_ValueError, "has other values than its spec says");
    if (lasts) frozen_remember(a->frozen, &found);
  }
  return true;
}

/* ---- all of them ---- */

/* Whether the argument may be there, or may not, beside the others. */
static bool call_may_have(const call *c, const parameter *p, bool given) {
  return (given || p->optional) && (p->with == NO_PARAMETER || given == !!c->arguments[p->with].data);
}

/* A letter that only absent inputs have is 0. Outputs bind no letter of an input: a kernel may look there. */
static void call_bind_absent(call *c, bool of_inputs) {
  for (int letter = 'A'; letter < LETTERS; letter++)
    if (c->size[letter] == UNBOUND && (!of_inputs || c->spec->of_inputs[letter])) c->size[letter] = 0;
}

static bool call_take(call *c, PyObject *const *objects, Py_ssize_t num) {
  const spec *s = c->spec;
  const int wanted = s->counts ? s->num_inputs : s->num;
  if (num != wanted)
    return PyErr_Format(PyExc_TypeError, "%s takes %d arguments, not %zd", s->name, wanted, num), false;
  for (int letter = 'A'; letter < LETTERS; letter++) c->size[letter] = UNBOUND;
  c->size[0] = 0;
  for (int i = 0; i < num; i++) {
    const parameter *p = &s->parameters[i];
    const bool given = objects[i] != Py_None;
    if (i == s->num_inputs) call_bind_absent(c, true);
    if (p->kind != ARRAY) {
      if (!call_take_number(c, i, objects[i])) return false;
      continue;
    }
    if (!call_may_have(c, p, given))
      return call_refuse(c, i, PyExc_ValueError, given ? "must be None" : "must not be None");
    if (given && !call_take_array(c, i, objects[i])) return false;
    if (given && !p->output && p->type != FLOATS && !argument_secure(&c->arguments[i])) return false;
  }
  call_bind_absent(c, false);
  for (int i = 0; i < num; i++)
    if (c->arguments[i].data && !check_values(c, i)) return false;
  return true;
}

/* ---- around a kernel ---- */

static bool call_begin(call *c) {
  for (int i = 0; debug && i < c->spec->num; i++) {
    argument *a = &c->arguments[i];
    if (!a->bytes) continue;
    if (c->spec->parameters[i].output) { /* all bits set: NaN, and -1 as an integer */
      const int64_t row = a->bytes / a->length;
      for (int64_t n = 0; n < a->length; n++) memset((char *)a->data + n * a->row_bytes, 0xff, (size_t)row);
    } else if (a->contiguous) {
      if (!(a->copy = malloc((size_t)a->bytes))) return PyErr_NoMemory(), false;
      memcpy(a->copy, a->data, (size_t)a->bytes);
    }
  }
  return true;
}

/* Makes the outputs of a kernel that counts them, by the sizes in the call; false with an exception set if there is no
 * memory. */
static bool call_make_outputs(call *c) {
  for (int i = c->spec->num_inputs; i < c->spec->num; i++) {
    argument *a = &c->arguments[i];
    a->length = call_value_of(c, &c->spec->parameters[i].shape[0]);
    a->row_bytes = sizeof(int64_t);
    a->bytes = a->length * a->row_bytes;
    if (!(a->frozen = frozen_new(a->bytes))) return false;
    a->data = a->frozen->shown;
  }
  return true;
}

/* Appends them to a list, as long as the sizes in the call say by now: where a kernel counts last, there was room for
 * more. */
static bool call_append_outputs(call *c, PyObject *list) {
  for (int i = c->spec->num_inputs; i < c->spec->num; i++) {
    frozen *f = c->arguments[i].frozen;
    const int64_t length = call_value_of(c, &c->spec->parameters[i].shape[0]);
    f->bytes = length * (int64_t)sizeof(int64_t);
    c->arguments[i].frozen = NULL;
    PyObject *array = frozen_array(f, 1, &length);
    const bool appended = array && PyList_Append(list, array) == 0;
    Py_XDECREF(array);
    if (!appended) return false;
  }
  return true;
}

static bool call_end(call *c, ast_status status) {
  bool ok = !PyErr_Occurred();
  for (int i = 0; debug && i < c->spec->num; i++) {
    argument *a = &c->arguments[i];
    if (!a->copy) continue;
    if (ok && memcmp(a->copy, a->data, (size_t)a->bytes))
      ok = PyErr_Format(PyExc_AssertionError, "%s: the kernel changed its input %s", c->spec->name, call_name_of(c, i));
    free(a->copy);
    a->copy = NULL;
  }
  if (!ok || status != AST_NO_MEMORY) return ok;
  PyErr_Format(PyExc_MemoryError, "%s: %s", c->spec->name, ast_status_text(status));
  return false;
}

#endif
