/* The Python module ast_sim._C: every function checks its arguments (arguments.h), then calls a kernel with the GIL released. */
#include "arguments.h"
#include "module_cells.h"
#include "module_layers.h"

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
    FAST(elastic_forces, "elastic_forces(position, rest_position, lame, elements, node_order, node_offsets, force)"),
    FAST(elastic_forces_backward,
         "elastic_forces_backward(dforce, position, rest_position, lame, elements, node_order, node_offsets, dposition)"),
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
