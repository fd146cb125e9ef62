/* Every allocation of a kernel fails in turn: the kernel says AST_NO_MEMORY, leaks nothing, and gives its usual result
 * when it is called again. Called a third time it allocates nothing.
 *
 * The linker sends the allocations of the whole program through the functions below (--wrap, see the Makefile). Each
 * attempt is made by fresh threads, which have no scratch memory yet. A new kernel is one function here and one line of
 * `cases`.
 */
#include <errno.h>
#include <limits.h>
#include <stdatomic.h>

#include "problems.h"

#ifdef __SANITIZE_ADDRESS__
enum { APART = true }; /* scratch memory: each request is an allocation then */
#else
enum { APART = false };
#endif

/* ---- allocations that fail ---- */

static atomic_bool armed, all_after; /* count allocations; all after the failing one fail too */
static atomic_long allocations, failing, failures, living;

static bool fails(void) {
  if (!atomic_load(&armed)) return false;
  const long n = atomic_fetch_add(&allocations, 1), wanted = atomic_load(&failing);
  const bool now = atomic_load(&all_after) ? n >= wanted : n == wanted;
  if (now) atomic_fetch_add(&failures, 1);
  return now;
}

static void *counted(void *p) {
  if (p) atomic_fetch_add(&living, 1);
  return p;
}

void *__real_malloc(size_t), *__real_calloc(size_t, size_t), *__real_realloc(void *, size_t),
    *__real_aligned_alloc(size_t, size_t);
int __real_posix_memalign(void **, size_t, size_t);
void __real_free(void *);
void *__wrap_malloc(size_t), *__wrap_calloc(size_t, size_t), *__wrap_realloc(void *, size_t),
    *__wrap_aligned_alloc(size_t, size_t);
int __wrap_posix_memalign(void **, size_t, size_t);
void __wrap_free(void *);

void *__wrap_malloc(size_t size) { return fails() ? NULL : counted(__real_malloc(size)); }
void *__wrap_calloc(size_t num, size_t size) { return fails() ? NULL : counted(__real_calloc(num, size)); }
void *__wrap_aligned_alloc(size_t alignment, size_t size) {
  return fails() ? NULL : counted(__real_aligned_alloc(alignment, size));
}
void *__wrap_realloc(void *p, size_t size) {
  if (fails()) return NULL;
  return p ? __real_realloc(p, size) : counted(__real_realloc(p, size));
}
int __wrap_posix_memalign(void **p, size_t alignment, size_t size) {
  if (fails()) return ENOMEM;
  const int error = __real_posix_memalign(p, alignment, size);
  if (!error) counted(*p);
  return error;
}
void __wrap_free(void *p) {
  if (p) atomic_fetch_sub(&living, 1);
  __real_free(p);
}

/* ---- one small problem a kernel ---- */

typedef struct {
  ast_status status;
  uint64_t digest; /* of all outputs, if the status is AST_OK */
} outcome;

#define KERNEL(call) (atomic_store(&armed, true), (call))

/* Ends the count that KERNEL began, reads the outputs and frees all buffers. */
static outcome finish(ast_status status, const void *const *outputs, size_t num_outputs) {
  atomic_store(&armed, false);
  outcome result = {status, 0xcbf29ce484222325u};
  for (size_t i = 0; status == AST_OK && i < num_outputs; i++) {
    const buffer *b = buffer_of(outputs[i]);
    for (size_t j = 0; j + 4 <= b->size; j += 4) {
      uint32_t word;
      memcpy(&word, b->data + j, sizeof word);
      result.digest = (result.digest ^ word) * 0x100000001b3u;
    }
  }
  while (num_buffers) free_buffers((const void *[]){buffers[0].data}, 1);
  return result;
}
#define FINISH(status, ...) finish(status, BUFFER_LIST(__VA_ARGS__))

/* 0, step, 2 step, ... */
static int64_t *even_offsets(int64_t num, int64_t step) {
  int64_t *offsets = new_ints(num + 1);
  for (int64_t i = 0; i <= num; i++) offsets[i] = i * step;
  return offsets;
}

static outcome segment(const ast_kernels *kernels, bool spread) {
  enum { F = 131, C = 300, LONG = 600, N = 3 * C + LONG };
  int64_t *offsets = even_offsets(C, 3), *order = even_offsets(N - 1, 1);
  offsets[C] += LONG; /* rows of more than one chain */
  float *x = random_floats((spread ? C : N) * F), *out = new_floats((spread ? N : C) * F);
  return FINISH(KERNEL((spread ? kernels->segment_spread : kernels->segment_sum)(x, F, order, offsets, C, true, out)),
                out);
}
static outcome segment_sum(const ast_kernels *kernels) { return segment(kernels, false); }
static outcome segment_spread(const ast_kernels *kernels) { return segment(kernels, true); }

static outcome octree_build(const ast_kernels *kernels, int depth) {
  enum { B = 3, N = 9000 };
  const double center[3] = {0, 0, 0};
  float *positions = random_floats(3 * N);
  int64_t *offsets = even_offsets(B, N / B), *keys = new_ints(N), *cell_offsets = new_ints(B + 1),
          *node_cell = new_ints(N);
  int64_t *node_order = new_ints(N), *node_offsets = new_ints(N + 1), bad = -1;
  return FINISH(KERNEL(kernels->octree_build(positions, offsets, B, center, 1, depth, keys, cell_offsets, node_cell,
                                             node_order, node_offsets, &bad)),
                keys, cell_offsets, node_cell, node_order, node_offsets);
}
static outcome octree_build_packed(const ast_kernels *kernels) { return octree_build(kernels, 12); }
static outcome octree_build_wide(const ast_kernels *kernels) { return octree_build(kernels, 21); }

/* Every fourth cell of a grid, by its keys: several chunks of coarse cells. */
static outcome octree_coarsen(const ast_kernels *kernels) {
  enum { B = 2, C = 34000 };
  int64_t *keys = new_ints(C), *offsets = even_offsets(B, C / B);
  for (int64_t i = 0; i < C; i++) keys[i] = 4 * (i % (C / B));
  AST_SCRATCH_SCOPE; /* of the level */
  ast_octree_level level;
  const ast_status status = KERNEL(kernels->octree_coarsen(keys, offsets, B, 1, &level));
  if (status != AST_OK) return finish(status, NULL, 0);
  int64_t *coarse_keys = new_ints(level.C), *coarse_offsets = new_ints(B + 1), *first_child = new_ints(level.C + 1),
          *parent = new_ints(C);
  int64_t *pairs[4];
  for (int i = 0; i < 4; i++) pairs[i] = new_ints(level.pair_offsets[27]);
  return FINISH(kernels->octree_write_level(&level, coarse_keys, coarse_offsets, first_child, parent, pairs[0],
                                            pairs[1], pairs[2], pairs[3]),
                coarse_keys, coarse_offsets, first_child, parent, pairs[0], pairs[1], pairs[2], pairs[3]);
}

static outcome sample(const ast_kernels *kernels, int64_t extent) {
  enum { B = 6, N = 200, NUM = 20 };
  int32_t *points = new_small_ints(3 * N * B);
  int64_t *offsets = even_offsets(B, N), *out_offsets = even_offsets(B, NUM), *indices = new_ints(B * NUM);
  for (int64_t i = 0; i < 3 * N * B; i++) points[i] = (int32_t)(random_bits() % (uint64_t)extent);
  return FINISH(KERNEL(kernels->farthest_point_sample(points, offsets, B, NUM, out_offsets, indices)), indices);
}
static outcome sample_narrow(const ast_kernels *kernels) { return sample(kernels, 1 << 12); }
static outcome sample_wide(const ast_kernels *kernels) { return sample(kernels, 1 << 20); }

enum { CELLS = 300, C_IN = 70, C_OUT = 20 };

static outcome sparse_conv(const ast_kernels *kernels) {
  const ast_pairs pairs = random_pairs(CELLS, CELLS, 1, 1);
  float *x = random_floats(CELLS * C_IN), *weight = random_floats(OFFSETS * C_IN * C_OUT),
        *out = new_floats(CELLS * C_OUT);
  return FINISH(KERNEL(kernels->sparse_conv(x, weight, NULL, C_IN, C_OUT, false, pairs, CELLS, out)), out);
}

static outcome sparse_conv_weight(const ast_kernels *kernels) {
  const ast_pairs pairs = random_pairs(CELLS, CELLS, 1, 1);
  float *x = random_floats(CELLS * C_IN), *dout = random_floats(CELLS * C_OUT),
        *dweight = new_floats(OFFSETS * C_IN * C_OUT);
  return FINISH(KERNEL(kernels->sparse_conv_weight(x, dout, C_IN, C_OUT, pairs, dweight)), dweight);
}

enum { SCENES = 2, QUERIES = 270, KEYS = 140, H = 2, D = 16, ROW = H * D };

static ast_attention attention_sizes(void) {
  return (ast_attention){.B = SCENES,
                         .H = H,
                         .D = D,
                         .q_offsets = even_offsets(SCENES, QUERIES),
                         .k_offsets = even_offsets(SCENES, KEYS),
                         .q_stride = ROW,
                         .k_stride = ROW,
                         .v_stride = ROW,
                         .dq_stride = ROW,
                         .dk_stride = ROW,
                         .dv_stride = ROW,
                         .scale = 0.25f,
                         .dropout_p = 0.1,
                         .seed = 5};
}

static outcome attention(const ast_kernels *kernels) {
  const ast_attention s = attention_sizes();
  float *q = random_floats(SCENES * QUERIES * ROW), *k = random_floats(SCENES * KEYS * ROW),
        *v = random_floats(SCENES * KEYS * ROW);
  float *out = new_floats(SCENES * QUERIES * ROW), *maximum = new_floats(SCENES * QUERIES * H),
        *sum = new_floats(SCENES * QUERIES * H);
  return FINISH(KERNEL(kernels->attention(&s, q, k, v, out, maximum, sum)), out, maximum, sum);
}

static outcome attention_backward(const ast_kernels *kernels) {
  const ast_attention s = attention_sizes();
  float *q = random_floats(SCENES * QUERIES * ROW), *k = random_floats(SCENES * KEYS * ROW),
        *v = random_floats(SCENES * KEYS * ROW);
  float *out = random_floats(SCENES * QUERIES * ROW), *maximum = new_floats(SCENES * QUERIES * H),
        *sum = new_floats(SCENES * QUERIES * H);
  float *dout = random_floats(SCENES * QUERIES * ROW), *dq = new_floats(SCENES * QUERIES * ROW);
  float *dk = new_floats(SCENES * KEYS * ROW), *dv = new_floats(SCENES * KEYS * ROW);
  for (int64_t i = 0; i < SCENES * QUERIES * H; i++) maximum[i] = 4, sum[i] = KEYS;
  return FINISH(KERNEL(kernels->attention_backward(&s, q, k, v, out, maximum, sum, dout, dq, dk, dv)), dq, dk, dv);
}

static outcome attention_block(const ast_kernels *kernels) {
  const ast_attention_block s = new_block(even_offsets(SCENES, QUERIES), even_offsets(SCENES, KEYS), SCENES, 40, 30, H,
                                          D, 24, true, random_floats);
  float *out = new_floats(s.Q * s.W);
  return FINISH(KERNEL(kernels->attention_block(&s, out, (ast_attention_block_kept){0})), out);
}

static outcome attention_block_backward(const ast_kernels *kernels) {
  const ast_attention_block s = new_block(even_offsets(SCENES, QUERIES), even_offsets(SCENES, KEYS), SCENES, 40, 30, H,
                                          D, 24, true, random_floats);
  const float *dout = random_floats(s.Q * s.W);
  const block_results r = new_block_results(&s, false);
  CHECK(kernels->attention_block(&s, r.of[0], r.kept) == AST_OK, "status");
  const void *outputs[BLOCK_RESULTS - 1];
  memcpy(outputs, r.of + 1, sizeof outputs);
  return finish(KERNEL(kernels->attention_block_backward(&s, dout, r.kept, r.gradients)), outputs, BLOCK_RESULTS - 1);
}

static ast_message message_case(void) { return new_message(6000, 3000, 3000, 3, 16, 24, 20, 1); }

static outcome message(const ast_kernels *kernels) {
  const ast_message s = message_case();
  const message_results r = new_message_results(&s);
  return FINISH(KERNEL(kernels->message(&s, r.of[SUM], r.of[MESSAGES])), r.of[SUM], r.of[MESSAGES]);
}

static outcome message_backward(const ast_kernels *kernels) {
  const ast_message s = message_case();
  const float *dsum = random_floats(s.R * s.F2), *dmessages = random_floats(s.M * s.F2);
  const message_results r = new_message_results(&s);
  const ast_message_gradients out = gradients_of(&r);
  const void *outputs[sizeof out / sizeof(void *)];
  memcpy(outputs, &out, sizeof out);
  return finish(KERNEL(kernels->message_backward(&s, dsum, dmessages, &out)), outputs, sizeof out / sizeof(void *));
}

enum { LINEAR_ROWS = 700, INPUTS = 40, OUTPUTS = 70 };

static outcome linear(const ast_kernels *kernels) {
  const ast_linear s = {LINEAR_ROWS, INPUTS, OUTPUTS, INPUTS, INPUTS, OUTPUTS / 2, OUTPUTS / 2, AST_GEGLU};
  float *x = random_floats(LINEAR_ROWS * INPUTS), *weight = random_floats(OUTPUTS * INPUTS),
        *bias = random_floats(OUTPUTS);
  float *residual = random_floats(LINEAR_ROWS * OUTPUTS / 2), *out = new_floats(LINEAR_ROWS * OUTPUTS / 2);
  return FINISH(KERNEL(kernels->linear(&s, x, weight, bias, residual, out, NULL)), out);
}

static outcome linear_backward(const ast_kernels *kernels) {
  const ast_linear s = {LINEAR_ROWS, INPUTS, OUTPUTS, INPUTS, INPUTS, OUTPUTS / 2, OUTPUTS / 2, AST_GEGLU};
  float *x = random_floats(LINEAR_ROWS * INPUTS), *weight = random_floats(OUTPUTS * INPUTS),
        *bias = random_floats(OUTPUTS);
  float *dout = random_floats(LINEAR_ROWS * OUTPUTS / 2), *dx = new_floats(LINEAR_ROWS * INPUTS);
  float *dweight = new_floats(OUTPUTS * INPUTS), *dbias = new_floats(OUTPUTS);
  return FINISH(KERNEL(kernels->linear_backward(&s, dout, x, weight, bias, NULL, dx, dweight, dbias)), dx, dweight,
                dbias);
}

enum { MLP_ROWS = 700, MLP_IN = 20, MLP_BESIDE = 9, MLP_HIDDEN = 40, MLP_OUT = 33 };

static ast_mlp mlp_case(void) {
  return (ast_mlp){
      .M = MLP_ROWS,
      .I = MLP_IN,
      .I2 = MLP_BESIDE,
      .H = MLP_HIDDEN,
      .O = MLP_OUT,
      .x_stride = MLP_IN,
      .beside_stride = MLP_BESIDE,
      .residual_stride = MLP_OUT,
      .dout_stride = MLP_OUT,
      .x = random_floats(MLP_ROWS * MLP_IN),
      .beside = random_floats(MLP_ROWS * MLP_BESIDE),
      .weight1 = random_floats(MLP_HIDDEN * (MLP_IN + MLP_BESIDE)),
      .bias1 = random_floats(MLP_HIDDEN),
      .weight2 = random_floats(MLP_OUT * MLP_HIDDEN),
      .bias2 = random_floats(MLP_OUT),
      .gamma = random_floats(MLP_OUT),
      .beta = random_floats(MLP_OUT),
  };
}

static outcome mlp(const ast_kernels *kernels) {
  const ast_mlp s = mlp_case();
  float *residual = random_floats(MLP_ROWS * MLP_OUT), *out = new_floats(MLP_ROWS * MLP_OUT);
  return FINISH(KERNEL(kernels->mlp(&s, residual, out, (ast_mlp_kept){0})), out);
}

static outcome mlp_backward(const ast_kernels *kernels) {
  const ast_mlp s = mlp_case();
  const float *dout = random_floats(MLP_ROWS * MLP_OUT);
  const ast_mlp_gradients out = {new_floats(MLP_ROWS * MLP_IN),
                                 new_floats(MLP_ROWS * MLP_BESIDE),
                                 new_floats(MLP_HIDDEN * (MLP_IN + MLP_BESIDE)),
                                 new_floats(MLP_HIDDEN),
                                 new_floats(MLP_OUT * MLP_HIDDEN),
                                 new_floats(MLP_OUT),
                                 new_floats(MLP_OUT),
                                 new_floats(MLP_OUT)};
  const void *outputs[sizeof out / sizeof(void *)];
  memcpy(outputs, &out, sizeof out);
  return finish(KERNEL(kernels->mlp_backward(&s, dout, (ast_mlp_kept){0}, out)), outputs, sizeof out / sizeof(void *));
}

static outcome elastic_forces(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(3000, 1);
  float *force = new_floats(3 * s.N);
  return FINISH(KERNEL(kernels->elastic_forces(&s, force)), force);
}

static outcome elastic_forces_backward(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(3000, 1);
  float *dforce = random_floats(3 * s.N), *dposition = new_floats(3 * s.N);
  return FINISH(KERNEL(kernels->elastic_forces_backward(&s, dforce, dposition)), dposition);
}

static outcome proximity(const ast_kernels *kernels) {
  const ast_proximity s = new_balls(3, 3, 12, 1, 0.2);
  float *out = new_floats(5 * s.N);
  return FINISH(KERNEL(kernels->proximity(&s, out)), out);
}

static outcome breadth_first(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(3000, 1);
  int64_t *wanted = new_ints(s.N), *rank = new_ints(s.N);
  for (int64_t n = 0; n < s.N; n++) wanted[n] = n % 7 > 0;
  const ast_status status = KERNEL(kernels->breadth_first(s.elements, s.E, 4, wanted, s.N, rank));
  return FINISH(status, rank);
}

static outcome counting_sort(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(3000, 1);
  int64_t *order = new_ints(4 * s.E), *offsets = new_ints(s.N + 1);
  const ast_status status = KERNEL(kernels->counting_sort(s.elements, 4 * s.E, s.N, order, offsets));
  return FINISH(status, order, offsets);
}

static outcome mesh_edges(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(3000, 1);
  int64_t *senders = new_ints(12 * s.E), *receivers = new_ints(12 * s.E), *offsets = new_ints(s.N + 1);
  const int64_t ends[] = {0, 1, 0, 2, 0, 3, 1, 2, 1, 3, 2, 3};
  const ast_status status = KERNEL(kernels->mesh_edges(s.elements, s.E, 4, ends, 6, s.N, senders, receivers, offsets));
  FREE(senders, receivers);
  return FINISH(status, offsets);
}

/* All elements share a node: the faces at it are too many to be compared pair by pair. */
static outcome outer_faces(const ast_kernels *kernels) {
  const ast_elastic s = new_elastic(300, 1);
  int64_t *elements = new_ints(4 * s.E), *outer = new_ints(4 * s.E), num = 0;
  for (int64_t i = 0; i < 4 * s.E; i++) elements[i] = i % 4 ? s.elements[i] : 0;
  const int64_t faces[] = {0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3};
  const ast_status status = KERNEL(kernels->outer_faces(elements, s.E, 4, faces, 4, outer, &num));
  for (int64_t i = num; i < 4 * s.E; i++) outer[i] = -1;
  return FINISH(status, outer);
}

static outcome column_sum(const ast_kernels *kernels) {
  enum { N = 9000, F = 70 };
  float *x = random_floats(N * F), *out = new_floats(F);
  return FINISH(KERNEL(kernels->column_sum(x, N, F, out)), out);
}

static outcome orthogonalize(const ast_kernels *kernels) {
  enum { K = 5, R = 70, C = 90 };
  float *x = random_floats(K * R * C), *out = new_floats(K * R * C);
  return FINISH(KERNEL(kernels->orthogonalize(x, K, R, C, out)), out);
}

static const struct {
  const char *name;
  outcome (*run)(const ast_kernels *);
} cases[] = {
    {"segment_sum", segment_sum},
    {"segment_spread", segment_spread},
    {"octree_build", octree_build_packed},
    {"octree_build, wide keys", octree_build_wide},
    {"octree_coarsen", octree_coarsen},
    {"farthest_point_sample", sample_narrow},
    {"farthest_point_sample, wide", sample_wide},
    {"sparse_conv", sparse_conv},
    {"sparse_conv_weight", sparse_conv_weight},
    {"attention", attention},
    {"attention_backward", attention_backward},
    {"attention_block", attention_block},
    {"attention_block_backward", attention_block_backward},
    {"message", message},
    {"message_backward", message_backward},
    {"linear", linear},
    {"linear_backward", linear_backward},
    {"mlp", mlp},
    {"orthogonalize", orthogonalize},
    {"mlp_backward", mlp_backward},
    {"elastic_forces", elastic_forces},
    {"elastic_forces_backward", elastic_forces_backward},
    {"proximity", proximity},
    {"breadth_first", breadth_first},
    {"counting_sort", counting_sort},
    {"mesh_edges", mesh_edges},
    {"outer_faces", outer_faces},
    {"column_sum", column_sum},
};

/* ---- attempts ---- */

typedef struct {
  const ast_kernels *kernels;
  outcome (*run)(const ast_kernels *);
  bool threaded;
  outcome first, again; /* with the allocation that fails, and without */
  long failures, third; /* allocations of a third call */
} attempt;

/* From a thread of its own: the case with the allocation that fails, then once more on the same threads. */
static void *make_attempt(void *p) {
  attempt *a = p;
  if (a->threaded) pool_start(CHECK_THREADS);
  atomic_store(&allocations, 0), atomic_store(&failures, 0);
  const bool none_fails = atomic_load(&failing) == LONG_MAX;
  check_state = 1;
  a->first = a->run(a->kernels);
  a->failures = atomic_load(&failures);
  atomic_store(&failing, LONG_MAX);
  check_state = 1;
  a->again = a->run(a->kernels);
  if (none_fails) {
    check_state = 1;
    atomic_store(&allocations, 0);
    a->run(a->kernels);
    a->third = atomic_load(&allocations);
  }
  if (a->threaded) pool_stop();
  return NULL;
}

static attempt attempt_in_thread(const ast_kernels *kernels, outcome (*run)(const ast_kernels *), bool threaded,
                                 long n) {
  attempt a = {.kernels = kernels, .run = run, .threaded = threaded};
  pthread_t thread;
  const long before = atomic_load(&living);
  atomic_store(&failing, n);
  CHECK(!pthread_create(&thread, NULL, make_attempt, &a) && !pthread_join(thread, NULL), "no thread");
  CHECK(atomic_load(&living) == before, "%ld blocks are not freed", atomic_load(&living) - before);
  return a;
}

static void test(const ast_kernels *kernels) {
  const bool threaded = ast_threads() > 1, quick = getenv("AST_TEST_QUICK") != NULL;
  if (threaded) pool_stop(); /* each attempt starts a fresh pool */
  for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
    const attempt usual = attempt_in_thread(kernels, cases[i].run, threaded, LONG_MAX);
    const uint64_t digest = usual.first.digest;
    CHECK(usual.first.status == AST_OK && usual.again.status == AST_OK && usual.again.digest == digest, "%s",
          cases[i].name);
    CHECK(threaded || APART || usual.third == 0, "%s: %ld allocations when it is called again", cases[i].name,
          usual.third);
    for (int mode = quick && threaded ? 1 : 0; mode < (quick && !threaded ? 1 : 2); mode++) {
      atomic_store(&all_after, mode == 1);
      for (long n = 0;; n++) {
        const attempt a = attempt_in_thread(kernels, cases[i].run, threaded, n);
        CHECK(a.first.status == (a.failures ? AST_NO_MEMORY : AST_OK), "%s, allocation %ld: status %d", cases[i].name,
              n, (int)a.first.status);
        CHECK(a.again.status == AST_OK && a.again.digest == digest && (a.failures || a.first.digest == digest),
              "%s, allocation %ld: another result", cases[i].name, n);
        if (!a.failures) break;
      }
    }
  }
  if (threaded) pool_start(CHECK_THREADS);
}

/* Requests keep apart, marks nest, and what is released is used again, from the second round on: only then one block is
 * large enough for all. A large stack is given back as a whole. */
static void *test_scratch(void *unused) {
  const long before = atomic_load(&living);
  for (int round = 0; round < 3; round++) {
    AST_SCRATCH_SCOPE;
    char *all[8], *again = NULL;
    for (int i = 0; i < 8; i++) all[i] = memset(ast_scratch(1 << 2 * i), i, 1 << 2 * i);
    for (int i = 0; i < 8; i++) {
      AST_SCRATCH_SCOPE;
      char *inner = ast_scratch(100000);
      CHECK(inner && (uintptr_t)inner % 64 == 0, "no memory, or not aligned");
      CHECK(APART || round == 0 || i == 0 || inner == again, "released memory is not used again");
      again = memset(inner, 99, 100000);
    }
    for (int i = 0; i < 8; i++)
      for (int j = 0; j < 1 << 2 * i; j++) CHECK(all[i][j] == i, "a later request writes into request %d", i);
  }
  CHECK(atomic_load(&living) <= before + 2, "%ld blocks are kept", atomic_load(&living) - before);
  void *const mark = ast_scratch_mark();
  CHECK(ast_scratch(1 << 27) && ast_scratch(1 << 20), "no memory");
  ast_scratch_release(mark);
  CHECK(atomic_load(&living) == before + 1, "%ld blocks are kept", atomic_load(&living) - before);
  return unused;
}

/* Each status has words of its own, and what is no status has some, too. */
static void test_texts(void) {
  const char *texts[AST_TOO_LARGE + 2];
  for (int i = 0; i <= AST_TOO_LARGE + 1; i++) {
    texts[i] = ast_status_text((ast_status)i);
    CHECK(texts[i] && *texts[i], "status %d has no text", i);
    for (int j = 0; j < i; j++) CHECK(strcmp(texts[i], texts[j]) != 0, "statuses %d and %d have one text", j, i);
  }
}

int main(void) {
  test_texts();
  pthread_t thread;
  CHECK(!pthread_create(&thread, NULL, test_scratch, NULL) && !pthread_join(thread, NULL), "no thread");
  on_every_table(test);
  return 0;
}
