/* The Python module ast_sim._C: every function checks its arguments (arguments.h), then calls a kernel with the GIL
 * released. */
#include "module_kernels.h"

/* ---- kernels ---- */

static PyObject *module_call_kernel(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  const binding *b = PyCapsule_GetPointer(self, NULL);
  if (!b) return NULL;
  call c = {.spec = &b->spec};
  PyObject *result = NULL;
  ast_status status;
  if (call_take(&c, objects, num) && (!b->check || b->check(&c))) {
    if (!b->count) {
      if (call_run(&c, b->run, NULL, &status) && (status == AST_OK || call_fail(&c, ast_status_text(status))))
        Py_INCREF(result = Py_None);
    } else if ((result = PyList_New(0)) && !b->count(&c, result)) Py_CLEAR(result);
  }
  call_release(&c);
  return result;
}

/* Whether this is something that a kernel reads as indices in place. */
static bool module_take_indices(PyObject *object, view *v, argument *a) {
  static const parameter contiguous;
  return view_of(object, v) && v->type == INTS && v->ndim >= 1 && v->ndim <= MAX_SHAPE &&
         argument_take_layout(&contiguous, v, a) && a->bytes;
}

/* A new array with these values, which kernels trust from now on (frozen.h). */
static PyObject *module_frozen_copy(const view *v, const argument *a) {
  frozen *f = frozen_new(a->bytes);
  if (!f) return NULL;
  memcpy(f->shown, a->data, (size_t)a->bytes);
  return frozen_array(f, v->ndim, v->shape);
}

/* The same object if there is nothing to do: it is frozen already, or no indices. */
static PyObject *module_freeze_one(PyObject *object) {
  view v;
  argument a;
  if (module_take_indices(object, &v, &a) && !frozen_find(a.data, a.bytes)) return module_frozen_copy(&v, &a);
  return Py_INCREF(object), object;
}

/* The same object if it is not frozen, or if what it shows is what kernels read. */
static PyObject *module_read_one(PyObject *object) {
  view v;
  argument a;
  if (!module_take_indices(object, &v, &a) || !frozen_find(a.data, a.bytes)) return Py_INCREF(object), object;
  PyObject *values = NULL;
  if (argument_secure(&a)) {
    if (memcmp(a.data, a.frozen->shown, (size_t)a.bytes)) values = module_frozen_copy(&v, &a);
    else Py_INCREF(values = object);
  }
  Py_DECREF(a.frozen->owner);
  return values;
}

static PyObject *module_of_each(PyObject *const *objects, Py_ssize_t num, PyObject *(*of)(PyObject *)) {
  PyObject *tuple = PyTuple_New(num);
  for (Py_ssize_t i = 0; tuple && i < num; i++) {
    PyObject *object = of(objects[i]);
    if (!object || PyTuple_SetItem(tuple, i, object)) Py_CLEAR(tuple);
  }
  return tuple;
}

static PyObject *module_freeze(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  return module_of_each(objects, num, module_freeze_one);
}

static PyObject *module_values_read(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  return module_of_each(objects, num, module_read_one);
}

static PyMethodDef kernel_methods[sizeof bindings / sizeof *bindings];

/* declare(name, names, numbers) adds the function of a kernel to the module: the names of the parameters that the call
 * of the kernel reads, "x, weight, out", and the numbers of its spec. */
static PyObject *module_declare(PyObject *module, PyObject *arguments) {
  const char *name, *names, *numbers;
  Py_ssize_t bytes;
  if (!PyArg_ParseTuple(arguments, "ssy#", &name, &names, &numbers, &bytes)) return NULL;
  size_t i = 0, num = sizeof bindings / sizeof *bindings;
  while (i < num && strcmp(bindings[i].spec.name, name) != 0) i++;
  if (i == num) return PyErr_Format(PyExc_ValueError, "declare: there is no kernel %s", name);
  spec *s = &bindings[i].spec;
  if (!spec_read(s, names, numbers, bytes))
    return PyErr_Format(PyExc_ValueError, "declare: %s takes (%s), its spec says something else", name, s->names);
  kernel_methods[i] = (PyMethodDef){s->name, (PyCFunction)(void (*)(void))module_call_kernel, METH_FASTCALL, s->names};
  PyObject *self = PyCapsule_New(&bindings[i], NULL, NULL);
  PyObject *function = self ? PyCFunction_NewEx(&kernel_methods[i], self, NULL) : NULL;
  const bool added = function && PyObject_SetAttrString(module, name, function) == 0;
  Py_XDECREF(self);
  Py_XDECREF(function);
  if (!added) return NULL;
  Py_RETURN_NONE;
}

/* ---- the stiffness of elastic tetrahedra, on arrays of NumPy: the solver knows no torch ---- */

enum { STIFFNESS_ARRAYS = 7, STIFFNESS_TABLES = 3 };
static const char *const stiffness_names[STIFFNESS_ARRAYS] = {"entries", "F", "gradients", "volume",
                                                              "mu",      "c", "spread"};

/* Whether the arrays fit together: those before STIFFNESS_TABLES end in the axis of the elements or points. */
static bool module_take_stiffness(PyObject *const *objects, Py_buffer *arrays, int *taken, ast_stiffness *s) {
  for (; *taken < STIFFNESS_ARRAYS; ++*taken) {
    Py_buffer *a = &arrays[*taken];
    const int writable = *taken ? 0 : PyBUF_WRITABLE;
    if (PyObject_GetBuffer(objects[*taken], a, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS | writable) != 0) return false;
    const int ndim = *taken == 0 ? 2 : *taken < STIFFNESS_TABLES ? 3 : 1;
    if (strcmp(a->format, "d") != 0 || a->ndim != ndim) {
      PyErr_Format(PyExc_ValueError, "elastic_stiffness: %s must be float64 of %d axes", stiffness_names[*taken], ndim);
      return ++*taken, false;
    }
  }
  const Py_ssize_t K = arrays[2].shape[0], Q = K == 4 ? 1 : 4, E = arrays[0].shape[1];
  bool fits = (K == 4 || K == 10) && arrays[0].shape[0] == 3 * K * (3 * K + 1) / 2 && arrays[1].shape[0] == 3;
  for (int i = 1; i < STIFFNESS_ARRAYS; i++) fits &= arrays[i].shape[arrays[i].ndim - 1] == Q * E;
  for (int i = 1; i < STIFFNESS_TABLES; i++) fits &= arrays[i].shape[1] == 3;
  *s = (ast_stiffness){E,
                       Q,
                       K,
                       arrays[1].buf,
                       arrays[2].buf,
                       .volume = arrays[3].buf,
                       .mu = arrays[4].buf,
                       .c = arrays[5].buf,
                       .spread = arrays[6].buf};
  if (!fits) PyErr_SetString(PyExc_ValueError, "elastic_stiffness: the shapes of the arrays do not fit together");
  return fits;
}

/* elastic_stiffness(entries, F, gradients, volume, mu, c, spread, project) writes entries; whether all are known. */
static PyObject *module_elastic_stiffness(PyObject *self, PyObject *const *objects, Py_ssize_t num) {
  (void)self;
  if (num != STIFFNESS_ARRAYS + 1)
    return PyErr_Format(PyExc_TypeError, "elastic_stiffness takes %d arguments, not %zd", STIFFNESS_ARRAYS + 1, num);
  const int project = PyObject_IsTrue(objects[STIFFNESS_ARRAYS]);
  if (project < 0) return NULL;
  Py_buffer arrays[STIFFNESS_ARRAYS];
  int taken = 0;
  ast_stiffness s;
  ast_status status = AST_OK;
  const bool fits = module_take_stiffness(objects, arrays, &taken, &s);
  if (fits) {
    s.project = project;
    Py_BEGIN_ALLOW_THREADS status = float32_kernels->elastic_stiffness(&s, arrays[0].buf);
    Py_END_ALLOW_THREADS
  }
  while (taken > 0) PyBuffer_Release(&arrays[--taken]);
  return fits ? PyBool_FromLong(status == AST_OK) : NULL;
}

/* ---- the process ---- */

/* The addresses of torch_parallel_for and torch_get_num_threads. */
static PyObject *module_set_pool(PyObject *self, PyObject *arguments) {
  (void)self;
  unsigned long long parallel_for, num_threads;
  if (!PyArg_ParseTuple(arguments, "KK", &parallel_for, &num_threads)) return NULL;
  ast_set_pool((ast_parallel_for)(uintptr_t)parallel_for, (ast_num_threads)(uintptr_t)num_threads);
  Py_RETURN_NONE;
}

static PyObject *module_keep_memory(PyObject *self, PyObject *unused) {
  (void)self, (void)unused;
  return PyBool_FromLong(ast_keep_memory());
}

static PyObject *module_configuration(PyObject *self, PyObject *unused) {
  (void)self, (void)unused;
  PyObject *supported = PyList_New(0);
  for (int i = 0; supported && ast_supported(i); i++) {
    PyObject *name = PyUnicode_FromString(ast_supported(i)->isa);
    if (!name || PyList_Insert(supported, 0, name)) Py_CLEAR(supported);
    Py_XDECREF(name);
  }
  if (!supported) return NULL;
  return Py_BuildValue("{s:s,s:N,s:z,s:L,s:O}", "isa", float32_kernels->isa, "supported", supported, "bfloat16",
                       bfloat16_kernels.isa, "threads", (long long)ast_threads(), "debug", debug ? Py_True : Py_False);
}

/* Whether products were in bfloat16 so far. */
static PyObject *module_multiply_in_bfloat16(PyObject *self, PyObject *wanted) {
  (void)self;
  const int on = PyObject_IsTrue(wanted);
  if (on < 0) return NULL;
  if (on && !bfloat16_kernels.isa) return PyErr_Format(PyExc_ValueError, "there are no products in bfloat16");
  const bool before = bfloat16_products;
  bfloat16_products = on;
  return PyBool_FromLong(before);
}

/* The float32 kernels; where another table has a kernel, it takes the place. */
static void module_prepare_bfloat16(const ast_kernels *table) {
  if (!table) return;
  bfloat16_kernels = *float32_kernels;
  bfloat16_kernels.isa = table->isa;
#define TAKE(kernel) \
  if (table->kernel) bfloat16_kernels.kernel = table->kernel;
  AST_KERNELS(TAKE)
}

static PyMethodDef methods[] = {
    {"declare", module_declare, METH_VARARGS,
     "declare(name, names, numbers): adds the kernel of this name, which takes what the numbers of its spec say."},
    {"freeze", (PyCFunction)(void (*)(void))module_freeze, METH_FASTCALL,
     "freeze(*indices): copies that kernels trust, or the arrays themselves if they are such."},
    {"values_read", (PyCFunction)(void (*)(void))module_values_read, METH_FASTCALL,
     "values_read(*objects): copies of what kernels read of frozen arrays that were written to since; else the same."},
    {"elastic_stiffness", (PyCFunction)(void (*)(void))module_elastic_stiffness, METH_FASTCALL,
     "elastic_stiffness(entries, F, gradients, volume, mu, c, spread, project): writes entries; whether all are "
     "known."},
    {"set_pool", module_set_pool, METH_VARARGS,
     "set_pool(parallel_for, num_threads): addresses of torch's thread pool, 0 for serial."},
    {"keep_memory", module_keep_memory, METH_NOARGS, "Let the C library keep freed blocks; whether it had an effect."},
    {"configuration", module_configuration, METH_NOARGS,
     "The chosen instruction set, the supported ones, the one for bfloat16 or None, the threads, the debug mode."},
    {"multiply_in_bfloat16", module_multiply_in_bfloat16, METH_O,
     "multiply_in_bfloat16(wanted): how dense layers of this thread multiply from now on; whether they did so before."},
    {NULL, NULL, 0, NULL},
};

static int module_execute(PyObject *module) {
  import_array1(-1);
  if (PyModule_AddStringConstant(module, "checks", check_names)) return -1;
  const char *wanted = getenv("AST_SIM_ISA"), *check = getenv("AST_SIM_DEBUG");
  debug = check && !strcmp(check, "1");
  float32_kernels = ast_select(wanted && *wanted ? wanted : NULL);
  if (float32_kernels) {
    if (!wanted || !*wanted) module_prepare_bfloat16(ast_bfloat16(0));
    return 0;
  }
  PyErr_Format(PyExc_ImportError,
               "AST_SIM_ISA=%s is not supported by this processor and build; unset it or choose base, avx2 or avx512",
               wanted);
  return -1;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, module_execute}, {0, NULL}};

static struct PyModuleDef definition = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "_C",
    .m_doc = "The C core of ast_sim. Use ast_sim.ops instead.",
    .m_methods = methods,
    .m_slots = slots,
};

PyMODINIT_FUNC PyInit__C(void) { return PyModuleDef_Init(&definition); }
