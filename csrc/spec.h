/* The text that says what a kernel takes, taken apart once, when Python declares it at import.
 *
 *   x[M,I] rows, weight[O,I], bias?[O], source[P] index(M), depth integer(0,21) -> out[M,O]
 *
 * An array has a dimension for each axis: a number, a letter, or a sum such as 4E, C+1, I+J. A letter binds at first sight; the same
 * letter is the same size ever after. `?` allows None. Behind the arrow stand outputs. csrc/README.md lists the words. Included by
 * arguments.h alone.
 */
#ifndef AST_SPEC_H
#define AST_SPEC_H

#include "view.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_PARAMETERS = 28, MAX_CHECKS = 2, MAX_NAME = 24, NO_PARAMETER = -1, LETTERS = 'Z' + 1 };

typedef struct {
  const char *text; /* in the spec, whose text is kept */
  int text_length;
  int64_t constant, factor[2];
  char letter[2]; /* 0 where there is no such term */
} dimension;

struct call;
struct argument;

/* Looks at the values of an index array: `bound` is the dimension that the spec names, `others` are the arrays that it names. */
typedef bool (*check_function)(const struct call *c, const struct argument *a, int64_t bound, const struct argument *const others[2]);

typedef struct {
  check_function function;
  dimension bound;
  int others[2];
} value_check;

typedef enum { ARRAY, INTEGER, NUMBER, BITS } parameter_kind;

typedef struct {
  char name[MAX_NAME];
  parameter_kind kind;
  bool optional, output;
  bool rows, filled; /* the rows may lie apart; there must be elements */
  int type, ndim;
  dimension shape[MAX_SHAPE];
  int64_t low, high; /* of an integer */
  int with, needs;   /* given exactly if that parameter is, or only if it is */
  value_check checks[MAX_CHECKS];
  int num_checks;
} parameter;

typedef struct {
  parameter parameters[MAX_PARAMETERS];
  int num;
  bool of_inputs[LETTERS]; /* the letters in shapes of inputs */
} spec;

typedef struct {
  const char *name;
  check_function function;
} named_check;

/* ---- reading ---- */

typedef struct {
  const char *at;
  spec *spec;
  const named_check *checks; /* the last one has no name */
} reader;

static void skip_spaces(reader *r) {
  while (*r->at == ' ' || *r->at == '\n') r->at++;
}

static bool accept(reader *r, const char *text) {
  skip_spaces(r);
  if (strncmp(r->at, text, strlen(text)) != 0) return false;
  r->at += strlen(text);
  return true;
}

static bool is_letter(char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_'; }

static bool read_word(reader *r, char word[MAX_NAME]) {
  size_t length = 0;
  skip_spaces(r);
  while (length < MAX_NAME - 1 && (is_letter(r->at[length]) || (length && r->at[length] >= '0' && r->at[length] <= '9'))) length++;
  memcpy(word, r->at, length);
  word[length] = 0;
  r->at += length;
  return length > 0;
}

static bool read_integer(reader *r, int64_t *out) {
  char *end;
  skip_spaces(r);
  *out = strtoll(r->at, &end, 10);
  if (end == r->at) return false;
  r->at = end;
  return true;
}

static bool read_dimension(reader *r, dimension *d) {
  skip_spaces(r);
  *d = (dimension){.text = r->at};
  int terms = 0;
  do {
    int64_t factor;
    const bool number = read_integer(r, &factor);
    const char letter = *r->at;
    if (letter >= 'A' && letter <= 'Z') {
      if (terms == 2) return false;
      d->letter[terms] = letter;
      d->factor[terms++] = number ? factor : 1;
      r->at++;
    } else if (number) d->constant += factor;
    else return false;
  } while (accept(r, "+"));
  d->text_length = (int)(r->at - d->text);
  return true;
}

static int find(const reader *r, const char *name) {
  for (int i = 0; i < r->spec->num; i++)
    if (!strcmp(r->spec->parameters[i].name, name)) return i;
  return NO_PARAMETER;
}

/* `(name)` of a parameter that stands before this one. */
static bool read_reference(reader *r, int *out) {
  char name[MAX_NAME];
  return accept(r, "(") && read_word(r, name) && (*out = find(r, name)) != NO_PARAMETER && accept(r, ")");
}

/* A check, and in parentheses a dimension or the names of arrays that stand before this one. */
static bool read_check(reader *r, parameter *p, check_function function) {
  if (p->num_checks == MAX_CHECKS) return false;
  value_check *check = &p->checks[p->num_checks++];
  *check = (value_check){.function = function, .others = {NO_PARAMETER, NO_PARAMETER}};
  p->type = INTS;
  if (!accept(r, "(")) return true;
  skip_spaces(r);
  if (!(*r->at >= 'a' && *r->at <= 'z')) return read_dimension(r, &check->bound) && accept(r, ")");
  for (int i = 0; i < 2; i++) {
    char name[MAX_NAME];
    if (!read_word(r, name) || (check->others[i] = find(r, name)) == NO_PARAMETER) return false;
    if (!accept(r, ",")) break;
  }
  return accept(r, ")");
}

static bool read_annotation(reader *r, parameter *p, const char *word) {
  if (!strcmp(word, "int64")) return p->type = INTS, true;
  if (!strcmp(word, "int32")) return p->type = SMALL_INTS, true;
  if (!strcmp(word, "rows")) return p->rows = true;
  if (!strcmp(word, "filled")) return p->filled = true;
  if (!strcmp(word, "number")) return p->kind = NUMBER, true;
  if (!strcmp(word, "bits")) return p->kind = BITS, true;
  if (!strcmp(word, "with")) return read_reference(r, &p->with);
  if (!strcmp(word, "needs")) return read_reference(r, &p->needs);
  if (!strcmp(word, "integer"))
    return accept(r, "(") && read_integer(r, &p->low) && accept(r, ",") && read_integer(r, &p->high) && accept(r, ")");
  for (const named_check *check = r->checks; check->name; check++)
    if (!strcmp(word, check->name)) return read_check(r, p, check->function);
  return false;
}

static bool read_parameter(reader *r, bool output) {
  if (r->spec->num == MAX_PARAMETERS) return false;
  parameter *p = &r->spec->parameters[r->spec->num];
  *p = (parameter){.kind = INTEGER, .output = output, .type = FLOATS, .with = NO_PARAMETER, .needs = NO_PARAMETER};
  if (!read_word(r, p->name)) return false;
  p->optional = accept(r, "?");
  if (accept(r, "[")) {
    p->kind = ARRAY;
    do {
      if (p->ndim == MAX_SHAPE || !read_dimension(r, &p->shape[p->ndim])) return false;
      for (int i = 0; !output && i < 2; i++) r->spec->of_inputs[(int)p->shape[p->ndim].letter[i]] = true;
      p->ndim++;
    } while (accept(r, ","));
    if (!accept(r, "]")) return false;
  }
  char word[MAX_NAME];
  while (read_word(r, word))
    if (!read_annotation(r, p, word)) return false;
  r->spec->num++;
  return true;
}

/* The place of the text that cannot be read, or NULL. */
static const char *read_spec(const char *text, const named_check *checks, spec *out) {
  reader r = {text, out, checks};
  *out = (spec){0};
  bool output = false;
  do {
    if (!read_parameter(&r, output)) return r.at;
    if (!output && accept(&r, "->")) {
      output = true;
      if (!read_parameter(&r, output)) return r.at;
    }
  } while (accept(&r, ","));
  skip_spaces(&r);
  return *r.at ? r.at : NULL;
}

#endif
