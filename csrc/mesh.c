/* What a mesh of elements says of its nodes: which of them an edge joins, and which faces belong to one element only.
 *
 * Both look at the corners of one node after the other, i = e K + k for corner k of element e. Runs of nodes are tasks.
 */
#include <stdlib.h>

#include "ast.h"
#include "simd.h"

enum {
  MESH_CHUNK = 1 << 14, /* nodes a task, at least */
  MESH_TASKS = 32,      /* at most: each task that looks for edges keeps a mark for each node */
  MESH_SHORT = 64       /* longer rows are left to qsort */
};

/* ---- edges ---- */

typedef struct {
  const int64_t *elements;
  int64_t K, N, chunk;
  const int64_t *corners, *corner_offsets; /* [E K], [N+1]: the corners at each node */
  const int64_t *beside, *beside_offsets;  /* [2 P], [K+1]: the corners that an edge joins to each corner */
  int64_t *senders, *receivers, *offsets;
  int64_t *starts; /* [tasks]: where the edges of each task begin; the tasks first count them there */
  bool counting;
} mesh_edges_job;

static int mesh_compare(const void *a, const void *b) {
  const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return (x > y) - (x < y);
}

static void mesh_sort(int64_t *values, int64_t num) {
  if (num > MESH_SHORT) {
    qsort(values, (size_t)num, sizeof *values, mesh_compare);
    return;
  }
  for (int64_t i = 1; i < num; i++) {
    const int64_t value = values[i];
    int64_t j = i;
    for (; j > 0 && values[j - 1] > value; j--) values[j] = values[j - 1];
    values[j] = value;
  }
}

/* The nodes that an edge joins to node n, each once: their number; written to `nodes`, unless it is NULL. */
AST_INLINE int64_t mesh_neighbours(const int64_t K, const mesh_edges_job *job, int64_t n, int64_t *marks,
                                   int64_t *nodes) {
  int64_t num = 0;
  marks[n] = n; /* an edge joins two nodes */
  for (int64_t i = job->corner_offsets[n]; i < job->corner_offsets[n + 1]; i++) {
    const int64_t k = job->corners[i] % K;
    const int64_t *element = job->elements + job->corners[i] - k;
    for (int64_t j = job->beside_offsets[k]; j < job->beside_offsets[k + 1]; j++) {
      const int64_t node = element[job->beside[j]];
      if (marks[node] == n) continue;
      marks[node] = n;
      if (nodes) nodes[num] = node;
      num++;
    }
  }
  return num;
}

/* The edges into the nodes of a task: they are counted, or written. */
AST_INLINE void mesh_edges_of(const int64_t K, const mesh_edges_job *job, int64_t index, int64_t *marks) {
  int64_t place = job->counting ? 0 : job->starts[index];
  for (int64_t n = index * job->chunk; n < min64(job->N, (index + 1) * job->chunk); n++) {
    int64_t *mine = job->counting ? NULL : job->senders + place;
    const int64_t num = mesh_neighbours(K, job, n, marks, mine);
    if (!job->counting) {
      mesh_sort(mine, num);
      for (int64_t j = 0; j < num; j++) job->receivers[place + j] = n;
      job->offsets[n + 1] = place + num;
    }
    place += num;
  }
  if (job->counting) job->starts[index] = place;
}

static ast_status mesh_edges_task(int64_t index, void *context) {
  const mesh_edges_job *job = context;
  int64_t *marks = ast_scratch(job->N * (int64_t)sizeof *marks);
  if (!marks) return AST_NO_MEMORY;
  memset(marks, 255, (size_t)job->N * sizeof *marks);
  if (job->K == 4) mesh_edges_of(4, job, index, marks); /* divisions by a constant are cheap */
  else mesh_edges_of(job->K, job, index, marks);
  return AST_OK;
}

static int64_t mesh_chunk(int64_t N) { return max64(MESH_CHUNK, divide_up(N, MESH_TASKS)); }

static ast_status mesh_edges(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict ends,
                             int64_t P, int64_t N, int64_t *restrict senders, int64_t *restrict receivers,
                             int64_t *restrict offsets) {
  AST_SCRATCH_SCOPE;
  const int64_t word = (int64_t)sizeof(int64_t), chunk = mesh_chunk(N), tasks = divide_up(N, chunk);
  int64_t *corners = ast_scratch(E * K * word), *corner_offsets = ast_scratch((N + 1) * word);
  int64_t *beside = ast_scratch(2 * P * word), *beside_offsets = ast_scratch((K + 1) * word);
  int64_t starts[MESH_TASKS] = {0};
  if (!corners || !corner_offsets || !beside || !beside_offsets) return AST_NO_MEMORY;
  counting_sort(elements, E * K, N, corners, corner_offsets);
  counting_sort(ends, 2 * P, K, beside, beside_offsets);
  for (int64_t j = 0; j < 2 * P; j++) beside[j] = ends[beside[j] ^ 1]; /* the other end */
  mesh_edges_job job = {elements,       K,       N,         chunk,   corners, corner_offsets,  beside,
                        beside_offsets, senders, receivers, offsets, starts,  .counting = true};
  offsets[0] = 0;
  const ast_status status = tasks > 1 ? ast_parallel(tasks, mesh_edges_task, &job) : AST_OK;
  if (status != AST_OK) return status;
  int64_t start = 0;
  for (int64_t i = 0; i < tasks; i++) {
    const int64_t num = starts[i];
    starts[i] = start;
    start += num;
  }
  job.counting = false;
  return ast_parallel(tasks, mesh_edges_task, &job);
}

/* ---- faces ---- */

/* A face of which only the smallest corner is known to be the same as another's. */
typedef struct {
  int64_t upper, number; /* middle N + largest of its corners; e Q + q */
} mesh_face;

typedef struct {
  int64_t N, chunk;
  const int64_t *order, *offsets; /* [E Q], [N+1]: the faces by their smallest corner */
  const int64_t *uppers;          /* [E Q], by face */
  bool *alone;                    /* [E Q], by face */
} mesh_faces_job;

static int mesh_compare_faces(const void *a, const void *b) {
  const mesh_face *x = a, *y = b;
  return (x->upper > y->upper) - (x->upper < y->upper);
}

/* Marks `num` faces of one smallest corner, few of them. */
static void mesh_mark_few(const mesh_faces_job *job, const int64_t *numbers, int64_t num) {
  int64_t uppers[MESH_SHORT];
  for (int64_t i = 0; i < num; i++) uppers[i] = job->uppers[numbers[i]];
  for (int64_t i = 0; i < num; i++) {
    int64_t like = 0;
    for (int64_t j = 0; j < num; j++) like += uppers[j] == uppers[i];
    job->alone[numbers[i]] = like == 1;
  }
}

/* The same for any number of them. */
static bool mesh_mark_many(const mesh_faces_job *job, const int64_t *numbers, int64_t num) {
  AST_SCRATCH_SCOPE;
  mesh_face *faces = ast_scratch(num * (int64_t)sizeof *faces);
  if (!faces) return false;
  for (int64_t i = 0; i < num; i++) faces[i] = (mesh_face){job->uppers[numbers[i]], numbers[i]};
  qsort(faces, (size_t)num, sizeof *faces, mesh_compare_faces);
  for (int64_t i = 0; i < num; i++)
    job->alone[faces[i].number] =
        (i == 0 || faces[i - 1].upper != faces[i].upper) && (i + 1 == num || faces[i + 1].upper != faces[i].upper);
  return true;
}

static ast_status mesh_faces_task(int64_t index, void *context) {
  const mesh_faces_job *job = context;
  for (int64_t n = index * job->chunk; n < min64(job->N, (index + 1) * job->chunk); n++) {
    const int64_t *numbers = job->order + job->offsets[n], num = job->offsets[n + 1] - job->offsets[n];
    if (num <= MESH_SHORT) mesh_mark_few(job, numbers, num);
    else if (!mesh_mark_many(job, numbers, num)) return AST_NO_MEMORY;
  }
  return AST_OK;
}

static ast_status outer_faces(const int64_t *restrict elements, int64_t E, int64_t K, const int64_t *restrict faces,
                              int64_t Q, int64_t *restrict outer, int64_t *num) {
  AST_SCRATCH_SCOPE;
  const int64_t word = (int64_t)sizeof(int64_t);
  int64_t N = 0; /* up to the last node of an element: there may be any number of others */
  for (int64_t i = 0; i < E * K; i++) N = max64(N, elements[i] + 1);
  int64_t *lowest = ast_scratch(E * Q * word), *uppers = ast_scratch(E * Q * word), *order = ast_scratch(E * Q * word);
  int64_t *offsets = ast_scratch((N + 1) * word);
  bool *alone = ast_scratch(E * Q);
  if (!lowest || !uppers || !order || !offsets || !alone) return AST_NO_MEMORY;
  for (int64_t e = 0; e < E; e++)
    for (int64_t q = 0; q < Q; q++) {
      const int64_t *corners = elements + e * K, *face = faces + q * 3;
      const int64_t a = corners[face[0]], b = corners[face[1]], c = corners[face[2]];
      const int64_t low = min64(a, min64(b, c)), high = max64(a, max64(b, c));
      lowest[e * Q + q] = low;
      uppers[e * Q + q] = (a + b + c - low - high) * N + high;
    }
  counting_sort(lowest, E * Q, N, order, offsets);
  mesh_faces_job job = {N, mesh_chunk(N), order, offsets, uppers, alone};
  const ast_status status = ast_parallel(divide_up(N, job.chunk), mesh_faces_task, &job);
  if (status != AST_OK) return status;
  *num = 0;
  for (int64_t i = 0; i < E * Q; i++)
    if (alone[i]) outer[(*num)++] = i;
  return AST_OK;
}
