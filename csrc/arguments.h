/* How the module takes its arguments apart: every array is checked for type, shape, layout and index range before a
 * kernel sees it.
 *
 * What a kernel takes stands in its spec (spec.h). Arrays are NumPy arrays or tensors (view.h) of exact dtype, aligned
 * and row major; outputs are allocated by the caller. A message names the kernel, the argument and the offending value.
 * In debug mode outputs are filled with NaN (integers: -1) before the kernel runs, and inputs are compared with copies
 * afterwards. Included by module.c alone.
 */
#ifndef AST_ARGUMENTS_H
#define AST_ARGUMENTS_H

#include "frozen.h"

#include <stdarg.h>

#undef I /* of complex.h, which NumPy includes: here it is a number of inputs */
#include "ast.h"

static const ast_kernels *kernels; /* of the chosen instruction set */
static bool debug;                 /* AST_SIM_DEBUG=1 */

typedef struct argument {
  const char *name;
  void *data;                 /* NULL where None was given */
  int64_t length, row_stride; /* rows, and items from row to row */
  int64_t integer;            /* also a number's 64 bits */
  double number;
  int64_t bytes, row_bytes; /* of all elements, and from row to row */
  bool dense;
  frozen *frozen; /* whose hidden copy `data` is, held during the call, or NULL */
  void *secured;  /* or a copy made for this call */
  void *copy;     /* debug: what an input held before the call */
} argument;

typedef struct call {
  const char *name;
  const spec *spec;
  int taken;             /* arguments */
  int64_t size[LETTERS]; /* by letter; UNBOUND before first sight */
  argument arguments[MAX_PARAMETERS];
} call;

enum { UNBOUND = -1 };

static bool fail(const call *c, PyObject *type, const char *format, ...) {
  va_list values;
  va_start(values, format);
  PyObject *text = PyUnicode_FromFormatV(format, values);
  va_end(values);
  if (text) PyErr_Format(type, "%s: %U", c->name, text);
  Py_XDECREF(text);
  return false;
}

/* ---- dimensions ---- */

static int64_t value_of(const call *c, const dimension *d) {
  int64_t value = d->constant;
  for (int i = 0; i < 2; i++) {
    const int64_t size = c->size[d->letter[i]];
    if (size != UNBOUND) value += d->factor[i] * size;
  }
  return value;
}

/* Whether an axis may be as long as this. A letter that stands alone binds at first sight; in a sum an absent one is 0.
 */
static bool fits(call *c, const dimension *d, int64_t length) {
  int64_t *size = &c->size[d->letter[0]];
  if (*size == UNBOUND && !d->letter[1]) {
    const int64_t rest = length - d->constant;
    if (rest < 0 || rest % d->factor[0]) return false;
    *size = rest / d->factor[0];
  }
  return length == value_of(c, d);
}

/* The dimension as a message shows it: its size, or the spec's text where that is not known. */
static int show_dimension(const call *c, const dimension *d, char *text, size_t room) {
  if (c->size[d->letter[0]] != UNBOUND || d->letter[1]) return snprintf(text, room, "%lld", (long long)value_of(c, d));
  return snprintf(text, room, "%s", d->text);
}

/* ---- arrays ---- */

/* The message of an argument that is `wanted`, and not as this attribute of it says. */
static bool fail_attribute(const call *c, PyObject *type, const char *name, const char *wanted, PyObject *object,
                           const char *attribute) {
  PyObject *value = PyObject_GetAttrString(object, attribute);
  PyObject *shown = value && strcmp(attribute, "shape") == 0 ? PySequence_Tuple(value) : value;
  if (shown) fail(c, type, "%s must %s, not %R", name, wanted, shown);
  if (shown != value) Py_XDECREF(shown);
  Py_XDECREF(value);
  return false;
}

static bool fail_type(const call *c, const parameter *p, PyObject *object) {
  const char *type = p->type == FLOATS ? "be float32" : p->type == INTS ? "be int64" : "be int32";
  return fail_attribute(c, PyExc_TypeError, p->name, type, object, "dtype");
}

static bool fail_shape(const call *c, const parameter *p, PyObject *object) {
  char wanted[200] = "have shape [";
  size_t used = strlen(wanted);
  for (int d = 0; d < p->ndim; d++) {
    if (d) used += (size_t)snprintf(wanted + used, sizeof wanted - used, ", ");
    used += (size_t)show_dimension(c, &p->shape[d], wanted + used, sizeof wanted - used);
  }
  snprintf(wanted + used, sizeof wanted - used, "]");
  return fail_attribute(c, PyExc_ValueError, p->name, wanted, object, "shape");
}

static bool check_layout(const call *c, const parameter *p, const view *v, argument *a) {
  const int64_t size = view_size(v);
  int64_t expected = v->item;
  if (!v->native) return fail(c, PyExc_ValueError, "%s must be aligned and in native byte order", p->name);
  a->dense = true;
  for (int d = v->ndim - 1; d >= 0; d--) {
    const int64_t stride = v->stride[d];
    if (size && v->shape[d] > 1 && stride != expected) {
      if (!p->rows || d > 0 || stride < expected || stride % v->item)
        return fail(c, PyExc_ValueError, "%s must be contiguous", p->name);
      a->dense = false;
    }
    if (d == 0) a->row_bytes = v->shape[0] > 1 ? stride : expected;
    expected *= v->shape[d];
  }
  a->length = v->shape[0];
  a->bytes = size * v->item;
  a->row_stride = a->row_bytes / v->item;
  return true;
}

/* Binds letters if the whole shape fits, and none if not: so the message names those that the array was to bind. */
static bool take_shape(call *c, const parameter *p, const view *v) {
  int first_seen[MAX_SHAPE], num = 0;
  bool right = v->ndim == p->ndim;
  for (int d = 0; right && d < p->ndim; d++) {
    const int letter = p->shape[d].letter[0];
    if (c->size[letter] == UNBOUND) first_seen[num++] = letter;
    right = fits(c, &p->shape[d], v->shape[d]);
  }
  while (!right && num) c->size[first_seen[--num]] = UNBOUND;
  return right;
}

static bool take_array(call *c, const parameter *p, PyObject *object, argument *a) {
  view v;
  if (!view_of(object, &v))
    return fail(c, PyExc_TypeError, "%s must be a NumPy array or a dense tensor on the CPU, not %R", p->name,
                (PyObject *)Py_TYPE(object));
  if (v.type != p->type) return fail_type(c, p, object);
  if (!take_shape(c, p, &v)) return fail_shape(c, p, object);
  if (p->filled && view_size(&v) == 0)
    return fail_attribute(c, PyExc_ValueError, p->name, "have a shape without 0", object, "shape");
  if (p->output && !v.writeable) return fail(c, PyExc_ValueError, "%s must be writeable", p->name);
  a->data = v.data;
  return check_layout(c, p, &v, a);
}

/* ---- numbers ---- */

/* An integer too large for C is out of range like any other; so is a float. */
static bool fail_number(const call *c, const parameter *p, PyObject *object) {
  if (!PyErr_ExceptionMatches(PyExc_OverflowError)) return false;
  PyErr_Clear();
  return fail(c, PyExc_ValueError, "%s must not be as large as %R", p->name, object);
}

static bool take_number(call *c, const parameter *p, PyObject *object, argument *a) {
  if (p->kind == NUMBER) a->number = PyFloat_AsDouble(object);
  else if (p->kind == BITS) a->integer = (int64_t)PyLong_AsUnsignedLongLongMask(object);
  else a->integer = PyLong_AsLongLong(object);
  if ((a->number == -1 || a->integer == -1) && PyErr_Occurred()) return fail_number(c, p, object);
  if (p->kind == INTEGER && (a->integer < p->low || a->integer > p->high))
    return fail(c, PyExc_ValueError, "%s must lie in %lld..%lld, not %lld", p->name, p->low, p->high,
                (long long)a->integer);
  return true;
}

/* ---- values ---- */

/* A failure of one element, named as Python would name it. */
static bool fail_element(const call *c, const argument *a, int64_t at, const char *problem, int64_t bound) {
  char place[60];
  if (a->row_stride > 1)
    snprintf(place, sizeof place, "%lld, %lld", (long long)(at / a->row_stride), (long long)(at % a->row_stride));
  else snprintf(place, sizeof place, "%lld", (long long)at);
  const int64_t value = ((const int64_t *)a->data)[at];
  return fail(c, PyExc_ValueError, "%s[%s] = %lld is %s %lld", a->name, place, (long long)value, problem,
              (long long)bound);
}

/* They start with 0, never fall and end at the bound. */
static bool check_offsets(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)others;
  const int64_t *offsets = a->data, n = a->length;
  if (n < 1 || offsets[0] != 0) return fail(c, PyExc_ValueError, "%s must start with 0", a->name);
  for (int64_t i = 1; i < n; i++)
    if (offsets[i] < offsets[i - 1])
      return fail(c, PyExc_ValueError, "%s must never fall, but falls to %lld at %lld", a->name, (long long)offsets[i],
                  (long long)i);
  if (offsets[n - 1] != bound)
    return fail(c, PyExc_ValueError, "%s must end at the number of rows %lld, not %lld", a->name, (long long)bound,
                (long long)offsets[n - 1]);
  return true;
}

static bool check_index(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)others;
  const int64_t *index = a->data, n = a->bytes / (int64_t)sizeof *index;
  for (int64_t i = 0; i < n; i++)
    if (index[i] < 0 || index[i] >= bound) return fail_element(c, a, i, "not an index below", bound);
  return true;
}

static bool check_permutation(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)bound;
  const int64_t *index = a->data, n = a->length;
  if (!check_index(c, a, n, others)) return false;
  uint8_t *seen = calloc((size_t)n / 8 + 1, 1);
  if (!seen) return PyErr_NoMemory(), false;
  int64_t twice = -1;
  for (int64_t i = 0; i < n; i++) {
    const uint8_t bit = (uint8_t)(1u << (index[i] & 7));
    if (seen[index[i] >> 3] & bit) twice = index[i];
    seen[index[i] >> 3] |= bit;
  }
  free(seen);
  return twice < 0 ||
         fail(c, PyExc_ValueError, "%s must be a permutation, but holds %lld twice", a->name, (long long)twice);
}

/* Strictly within each group of pairs; the other array are the offsets of the groups. */
static bool check_rising(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)bound;
  const int64_t *offset = others[0]->data, *index = a->data;
  for (int64_t k = 0; k + 1 < others[0]->length; k++)
    for (int64_t i = offset[k] + 1; i < offset[k + 1]; i++)
      if (index[i] <= index[i - 1])
        return fail(c, PyExc_ValueError, "%s must rise strictly within each kernel offset, but does not at %lld",
                    a->name, (long long)i);
  return true;
}

/* The other array are the keys of the cells: at least 0, and strictly rising within each scene. */
static bool check_scenes(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)bound;
  const int64_t *key = others[0]->data, *offset = a->data;
  const char *name = others[0]->name;
  for (int64_t b = 0; b + 1 < a->length; b++)
    for (int64_t i = offset[b]; i < offset[b + 1]; i++)
      if (key[i] < 0 || (i > offset[b] && key[i] <= key[i - 1]))
        return fail(c, PyExc_ValueError,
                    "%s must be at least 0 and rise strictly within each scene, but %s[%lld] is %lld", name, name,
                    (long long)i, (long long)key[i]);
  return true;
}

/* The other array holds the number of the segment of each row. */
static bool check_segments(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)bound;
  const int64_t *segment = others[0]->data, *offset = a->data;
  for (int64_t r = 0; r + 1 < a->length; r++)
    for (int64_t m = offset[r]; m < offset[r + 1]; m++)
      if (segment[m] != r)
        return fail(c, PyExc_ValueError, "%s[%lld] is %lld, but %s say %lld", others[0]->name, (long long)m,
                    (long long)segment[m], a->name, (long long)r);
  return true;
}

/* The others are elements and the order of their corners. Each corner stands once, at its node, and the corners of a
 * node rise: so the elements hold indices of nodes. Where they do not, that is what the message says. */
static bool check_corners(const call *c, const argument *a, int64_t bound, const argument *const others[2]) {
  (void)bound;
  const argument *const none[2] = {NULL, NULL};
  const int64_t *node = others[0]->data, *corner = others[1]->data, *offset = a->data, corners = others[1]->length;
  for (int64_t n = 0; n + 1 < a->length; n++) {
    bool wrong = false; /* without branches */
    for (int64_t j = offset[n]; j < offset[n + 1]; j++) {
      const bool inside = (uint64_t)corner[j] < (uint64_t)corners, rises = j == offset[n] || corner[j] > corner[j - 1];
      wrong |= !inside | !rises | (node[inside ? corner[j] : 0] != n);
    }
    if (wrong)
      return check_index(c, others[0], a->length - 1, none) &&
             fail(c, PyExc_ValueError, "%s[%lld:%lld] must be the corners of elements at node %lld, ascending",
                  others[1]->name, (long long)offset[n], (long long)offset[n + 1], (long long)n);
  }
  return true;
}

static const named_check value_checks[] = {
    {"offsets", check_offsets},         {"index", check_index},
    {"permutation", check_permutation}, {"rising", check_rising},
    {"scenes", check_scenes},           {"segments", check_segments},
    {"corners", check_corners},         {NULL, NULL},
};

/* Puts integers where no other thread can change them (frozen.h): all checks and the kernel read them there. */
static bool secure(argument *a) {
  if (!a->bytes) return true;
  if ((a->frozen = find_frozen(a->data, a->bytes))) {
    Py_INCREF(a->frozen->owner);
    a->data = a->frozen->hidden;
    return true;
  }
  if (!(a->secured = malloc((size_t)a->bytes))) return PyErr_NoMemory(), false;
  a->data = memcpy(a->secured, a->data, (size_t)a->bytes);
  return true;
}

static void release(call *c) {
  for (int i = 0; i < c->taken; i++) {
    if (c->arguments[i].frozen) Py_DECREF(c->arguments[i].frozen->owner);
    free(c->arguments[i].secured);
  }
}

static bool check_values(const call *c, const parameter *p, const argument *a) {
  for (int i = 0; i < p->num_checks; i++) {
    const value_check *check = &p->checks[i];
    const argument *others[2];
    fact found = {check->function, value_of(c, &check->bound), {0, 0}};
    bool lasts = a->frozen;
    for (int j = 0; j < 2; j++) {
      others[j] = check->others[j] == NO_PARAMETER ? NULL : &c->arguments[check->others[j]];
      if (others[j] && others[j]->frozen) found.others[j] = others[j]->frozen->number;
      else if (others[j]) lasts = false;
    }
    if (lasts && is_known(a->frozen, &found)) continue;
    if (!check->function(c, a, found.bound, others)) return false;
    if (lasts) remember(a->frozen, &found);
  }
  return true;
}

/* ---- all of them ---- */

/* Whether the argument may be there, or may not, beside the others. */
static bool check_presence(const call *c, const parameter *p, bool given) {
  if (!given && !p->optional) return fail(c, PyExc_TypeError, "%s must not be None", p->name);
  if (p->with != NO_PARAMETER && given != !!c->arguments[p->with].data)
    return fail(c, PyExc_ValueError, "%s and %s go together", c->spec->parameters[p->with].name, p->name);
  if (given && p->needs != NO_PARAMETER && !c->arguments[p->needs].data)
    return fail(c, PyExc_ValueError, "%s needs %s", p->name, c->spec->parameters[p->needs].name);
  return true;
}

/* A letter that only absent inputs have is 0. Outputs bind no letter of an input: a kernel may look there. */
static void bind_absent(call *c, bool of_inputs) {
  for (int letter = 'A'; letter < LETTERS; letter++)
    if (c->size[letter] == UNBOUND && (!of_inputs || c->spec->of_inputs[letter])) c->size[letter] = 0;
}

static bool take(call *c, PyObject *const *objects, Py_ssize_t num) {
  const spec *s = c->spec;
  if (num != s->num)
    return PyErr_Format(PyExc_TypeError, "%s takes %d arguments, not %zd", c->name, s->num, num), false;
  for (int letter = 'A'; letter < LETTERS; letter++) c->size[letter] = UNBOUND;
  c->size[0] = 0;
  for (int i = 0; i < num; i++) {
    const parameter *p = &s->parameters[i];
    c->arguments[i] = (argument){.name = p->name};
    c->taken = i + 1;
    if (p->output && (i == 0 || !s->parameters[i - 1].output)) bind_absent(c, true);
    if (p->kind != ARRAY) {
      if (!take_number(c, p, objects[i], &c->arguments[i])) return false;
      continue;
    }
    const bool given = objects[i] != Py_None;
    if (!check_presence(c, p, given) || (given && !take_array(c, p, objects[i], &c->arguments[i]))) return false;
    if (given && !p->output && p->type != FLOATS && !secure(&c->arguments[i])) return false;
  }
  bind_absent(c, false);
  for (int i = 0; i < num; i++)
    if (s->parameters[i].num_checks && c->arguments[i].data && !check_values(c, &s->parameters[i], &c->arguments[i]))
      return false;
  return true;
}

/* ---- around a kernel ---- */

static bool begin(call *c) {
  for (int i = 0; debug && i < c->spec->num; i++) {
    argument *a = &c->arguments[i];
    if (!a->bytes) continue;
    if (c->spec->parameters[i].output) { /* all bits set: NaN, and -1 as an integer */
      const int64_t row = a->bytes / a->length;
      for (int64_t n = 0; n < a->length; n++) memset((char *)a->data + n * a->row_bytes, 0xff, (size_t)row);
    } else if (a->dense) {
      if (!(a->copy = malloc((size_t)a->bytes))) return PyErr_NoMemory(), false;
      memcpy(a->copy, a->data, (size_t)a->bytes);
    }
  }
  return true;
}

static bool end(call *c, ast_status status) {
  bool ok = !PyErr_Occurred();
  for (int i = 0; debug && i < c->spec->num; i++) {
    argument *a = &c->arguments[i];
    if (!a->copy) continue;
    if (ok && memcmp(a->copy, a->data, (size_t)a->bytes))
      ok = fail(c, PyExc_AssertionError, "the kernel changed its input %s", a->name);
    free(a->copy);
  }
  return ok && (status != AST_NO_MEMORY || (PyErr_NoMemory(), false));
}

#endif
