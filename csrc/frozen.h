/* Index arrays whose values kernels read where nobody can change them, so that a check holds for ever.
 *
 * A kernel reads wherever an index points, and another thread may write to a tensor between the check and the kernel.
 * So a kernel reads integers only from memory that Python cannot reach. The tensor that Python gets lies over the
 * memory that is shown; the first kernel to read it makes a private copy, and all kernels read that. torch's ops take
 * tensors and nothing else: the address of the shown memory says which block a tensor belongs to, through autograd and
 * views alike. The block lives as long as its storage, so no other tensor has that address meanwhile. Checks that the
 * private copy passed are kept in the block. Integers that are not frozen are copied in every call (arguments.h). All
 * of it happens under the interpreter's lock. Included by arguments.h alone.
 */
#ifndef AST_FROZEN_H
#define AST_FROZEN_H

#include "spec.h"

enum { MAX_FACTS = 8, BUCKETS = 4096, ALIGNMENT = 64 };

/* A check that the array passed. The other arrays are frozen, too; no two blocks ever have the same number. */
typedef struct {
  int64_t check, bound, others[2];
} fact;

typedef struct frozen {
  struct frozen *next;  /* in its bucket */
  PyObject *owner;      /* the capsule that frees this block */
  void *shown, *copied; /* copied: NULL before a kernel reads it */
  int64_t bytes, number;
  fact facts[MAX_FACTS];
  int num_facts; /* the newest MAX_FACTS are kept */
} frozen;

static frozen *buckets[BUCKETS];

static frozen **frozen_bucket(const void *shown) { return &buckets[(uintptr_t)shown / ALIGNMENT % BUCKETS]; }

/* The block of an array that is shown from this address on, or NULL. A part of one is not frozen. */
static frozen *frozen_find(const void *shown, int64_t bytes) {
  for (frozen *f = *frozen_bucket(shown); f; f = f->next)
    if (f->shown == shown) return f->bytes == bytes ? f : NULL;
  return NULL;
}

static void frozen_forget(PyObject *capsule) {
  frozen *f = PyCapsule_GetPointer(capsule, NULL), **link = frozen_bucket(f->shown);
  while (*link != f) link = &(*link)->next;
  *link = f->next;
  free(f->copied);
  free(f);
}

/* Never 0, so that every block has an address of its own. */
static int64_t frozen_aligned(int64_t bytes) { return bytes / ALIGNMENT * ALIGNMENT + ALIGNMENT; }

/* A new block; its values are unset. */
static frozen *frozen_new(int64_t bytes) {
  static int64_t number;
  const int64_t head = frozen_aligned(sizeof(frozen));
  char *memory = aligned_alloc(ALIGNMENT, (size_t)(head + frozen_aligned(bytes)));
  if (!memory) return (void)PyErr_NoMemory(), NULL;
  frozen *f = (frozen *)memory, **bucket = frozen_bucket(memory + head);
  *f = (frozen){.shown = memory + head, .bytes = bytes, .number = ++number};
  if (!(f->owner = PyCapsule_New(f, NULL, frozen_forget))) return free(f), NULL;
  f->next = *bucket;
  *bucket = f;
  return f;
}

/* The array over what is shown, which from now on owns the block. */
static PyObject *frozen_array(frozen *f, int ndim, const int64_t *shape) {
  npy_intp lengths[MAX_SHAPE];
  for (int d = 0; d < ndim; d++) lengths[d] = (npy_intp)shape[d];
  PyObject *array = PyArray_SimpleNewFromData(ndim, lengths, INTS, f->shown);
  if (!array) Py_DECREF(f->owner);
  else if (PyArray_SetBaseObject((PyArrayObject *)array, f->owner))
    Py_CLEAR(array); /* took the reference all the same */
  return array;
}

static bool frozen_knows(const frozen *f, const fact *wanted) {
  for (int i = 0; i < f->num_facts && i < MAX_FACTS; i++)
    if (memcmp(&f->facts[i], wanted, sizeof *wanted) == 0) return true;
  return false;
}

static void frozen_remember(frozen *f, const fact *found) { f->facts[f->num_facts++ % MAX_FACTS] = *found; }

#endif
