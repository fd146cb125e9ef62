/* The module's functions of features: attention, message passing, dense layers. Included by module.c alone. */
#ifndef AST_MODULE_LAYERS_H
#define AST_MODULE_LAYERS_H

#include "arguments.h"

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

/* Without an encoder edge features are added to of_senders and of_receivers; none at all are [M, 0]. */
static bool check_latents(const call *c, int64_t E, int64_t H, int64_t F) {
  if (H || !E || E == F) return true;
  return fail(c, PyExc_ValueError, "edge_features without an encoder must have the %lld channels of of_senders, not %lld", (long long)F,
              (long long)E);
}

static bool take_message(call *c, ast_message *s) {
  argument *P, *Q, *e, *A1, *a1, *A2, *W2, *b2, *gamma, *beta, *senders, *receivers, *offsets;
  if (!(P = IN(c, "of_senders", FLOATS, 2, FREE, FREE)) || !(Q = IN(c, "of_receivers", FLOATS, 2, FREE, P->shape[1])) ||
      !(e = IN(c, "edge_features", FLOATS, 2, FREE, FREE)) || !(A1 = IN(c, "A1", FLOATS, 2, FREE, e->shape[1])) ||
      !(a1 = IN(c, "a1", FLOATS, 1, A1->shape[0])) || !(A2 = IN(c, "A2", FLOATS, 2, P->shape[1], A1->shape[0])) ||
      !(W2 = IN(c, "W2", FLOATS, 2, FREE, P->shape[1])) || !(b2 = IN(c, "b2", FLOATS, 1, W2->shape[0])) ||
      !(gamma = IN(c, "gamma", FLOATS, 1, W2->shape[0])) || !(beta = IN(c, "beta", FLOATS, 1, W2->shape[0])) ||
      !(senders = IN(c, "senders", INTS, 1, e->shape[0])) || !(receivers = IN(c, "receivers", INTS, 1, e->shape[0])) ||
      !(offsets = IN(c, "receiver_offsets", INTS, 1, Q->shape[0] + 1)) || !check_latents(c, e->shape[1], A1->shape[0], P->shape[1]) ||
      !check_offsets(c, offsets, e->shape[0]) || !check_indices(c, senders, e->shape[0], P->shape[0]) ||
      !check_receivers(c, receivers, offsets))
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

/* ---- dense layers ---- */

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

#endif
