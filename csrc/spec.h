/* What a kernel takes: its spec, which ast_sim/ops/spec.py takes apart once at import and hands over in numbers.
 *
 *   x[M,I] rows_apart, weight[O,I] filled, bias?[O], source[P] index(M), depth integer(0,21) -> out[M,O]
 *
 * An array has a dimension for each axis: a number, a letter, or a sum such as 4E, C+1, I+J. A letter binds at first
 * sight; the same letter is the same size ever after. `?` allows None. Behind the arrow stand outputs. README.md lists
 * the words. Included by frozen.h alone.
 */
#ifndef AST_SPEC_H
#define AST_SPEC_H

#include "view.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_PARAMETERS = 48, MAX_CHECKS = 2, NO_PARAMETER = -1, LETTERS = 'Z' + 1 };
enum { ARRAY, INTEGER, NUMBER, BITS }; /* kinds */

/* All of these are numbers of 64 bits, in the order in which they come from Python. */
typedef struct {
  int64_t constant, factor[2], letter[2]; /* letter 0 where there is no such term */
} dimension;

typedef struct {
  int64_t check; /* its number in `checks` (arguments.h) */
  dimension bound;
  int64_t others[2]; /* arrays that it looks at, too */
} value_check;

typedef struct {
  int64_t kind, type;
  int64_t optional, output, rows_apart, filled; /* rows_apart: they may be; filled: there must be elements */
  int64_t low, high; /* of an integer from low to high, or of a number in [low, high) if low < high */
  int64_t with;      /* given exactly if that parameter is */
  int64_t ndim, num_checks;
  dimension shape[MAX_SHAPE]; /* of an integer the first is the letter whose size it is, if it is one */
  value_check checks[MAX_CHECKS];
} parameter;

typedef struct {
  const char *name, *names; /* of the kernel, and of its parameters: "x, weight, out" */
  bool counts; /* the kernel counts its outputs, one-dimensional integers, which the core makes; others are given */
  int num, num_inputs;
  parameter parameters[MAX_PARAMETERS];
  bool of_inputs[LETTERS]; /* the letters in shapes of inputs */
} spec;

/* False if these are the numbers of no spec of a kernel with such parameters. */
static bool spec_read(spec *s, const char *names, const char *numbers, Py_ssize_t bytes) {
  s->num = (int)(bytes / (Py_ssize_t)sizeof(parameter));
  if (strcmp(s->names, names) != 0 || s->num > MAX_PARAMETERS || bytes % (Py_ssize_t)sizeof(parameter)) return false;
  memcpy(s->parameters, numbers, (size_t)bytes);
  for (s->num_inputs = 0; s->num_inputs < s->num && !s->parameters[s->num_inputs].output; s->num_inputs++) {
  }
  for (int i = 0; i < s->num_inputs; i++)
    for (int d = 0; d < MAX_SHAPE; d++)
      for (int term = 0; term < 2; term++) s->of_inputs[s->parameters[i].shape[d].letter[term]] = true;
  return true;
}

#endif
