/* What a kernel takes: its spec, which ast_sim/ops/spec.py takes apart once at import and hands over in numbers.
 *
 *   x[M,I] rows, weight[O,I] filled, bias?[O], source[P] index(M), depth integer(0,21) -> out[M,O]
 *
 * An array has a dimension for each axis: a number, a letter, or a sum such as 4E, C+1, I+J. A letter binds at first
 * sight; the same letter is the same size ever after. `?` allows None. Behind the arrow stand outputs. README.md lists
 * the words. Included by arguments.h alone.
 */
#ifndef AST_SPEC_H
#define AST_SPEC_H

#include "view.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_PARAMETERS = 28, MAX_CHECKS = 2, NO_PARAMETER = -1, LETTERS = 'Z' + 1 };

typedef struct {
  const char *text;
  long long constant, factor[2];
  int letter[2]; /* 0 where there is no such term */
} dimension;

struct call;
struct argument;

/* Looks at the values of an index array: `bound` is the dimension that the spec names, `others` are the arrays that it
 * names. */
typedef bool (*check_function)(const struct call *c, const struct argument *a, int64_t bound,
                               const struct argument *const others[2]);

typedef struct {
  check_function function;
  dimension bound;
  int others[2];
} value_check;

typedef enum { ARRAY, INTEGER, NUMBER, BITS } parameter_kind;

typedef struct {
  const char *name;
  int kind, type;
  int optional, output, rows, filled; /* rows: they may lie apart; filled: there must be elements */
  long long low, high;                /* of an integer */
  int with, needs;                    /* given exactly if that parameter is, or only if it is */
  int ndim, num_checks;
  dimension shape[MAX_SHAPE];
  value_check checks[MAX_CHECKS];
} parameter;

typedef struct {
  int num;
  parameter parameters[MAX_PARAMETERS];
  bool of_inputs[LETTERS]; /* the letters in shapes of inputs */
} spec;

typedef struct {
  const char *name;
  check_function function;
} named_check;

static bool read_dimension(PyObject *tuple, dimension *d) {
  return PyArg_ParseTuple(tuple, "sLLCLC", &d->text, &d->constant, &d->factor[0], &d->letter[0], &d->factor[1],
                          &d->letter[1]) &&
         d->letter[0] < LETTERS && d->letter[1] < LETTERS;
}

static bool read_check(PyObject *tuple, const named_check *known, value_check *check) {
  const char *name;
  PyObject *bound;
  if (!PyArg_ParseTuple(tuple, "sOii", &name, &bound, &check->others[0], &check->others[1])) return false;
  while (known->name && strcmp(known->name, name) != 0) known++;
  check->function = known->function;
  return known->name && read_dimension(bound, &check->bound);
}

static bool read_parameter(PyObject *tuple, const named_check *known, parameter *p) {
  PyObject *shape, *checks;
  if (!PyArg_ParseTuple(tuple, "siippppLLiiOO", &p->name, &p->kind, &p->type, &p->optional, &p->output, &p->rows,
                        &p->filled, &p->low, &p->high, &p->with, &p->needs, &shape, &checks))
    return false;
  p->ndim = (int)PyTuple_Size(shape), p->num_checks = (int)PyTuple_Size(checks);
  bool ok = p->ndim <= MAX_SHAPE && p->num_checks <= MAX_CHECKS;
  for (int d = 0; ok && d < p->ndim; d++) ok = read_dimension(PyTuple_GetItem(shape, d), &p->shape[d]);
  for (int i = 0; ok && i < p->num_checks; i++) ok = read_check(PyTuple_GetItem(checks, i), known, &p->checks[i]);
  return ok;
}

/* The tuple is kept, for its texts are. False if it is no spec. */
static bool read_spec(PyObject *tuple, const named_check *known, spec *s) {
  s->num = (int)PyTuple_Size(tuple);
  bool ok = s->num >= 0 && s->num <= MAX_PARAMETERS;
  for (int i = 0; ok && i < s->num; i++) {
    parameter *p = &s->parameters[i];
    ok = read_parameter(PyTuple_GetItem(tuple, i), known, p);
    for (int d = 0; ok && !p->output && d < p->ndim; d++)
      for (int term = 0; term < 2; term++) s->of_inputs[p->shape[d].letter[term]] = true;
  }
  Py_INCREF(tuple);
  return ok;
}

#endif
