/* Message passing over the edges of a graph, fused: no array of the width of a feature is written per edge.
 *
 *   h_m = relu(A1 e_m + a1)                          edge encoder, absent if H = 0
 *   x_m = relu(P_s(m) + Q_r(m) + A2 h_m)             first layer; P and Q are its products with senders and receivers
 *   x_m = relu(P_s(m) + Q_r(m) + e_m)                the same where e_m, of F channels, is its product with latents of the edges
 *   y_m = W2 x_m + b2                                second layer
 *   out_m = gamma (y_m - mean y_m) / sqrt(var y_m + eps) + beta,     sum_r = sum of out_m over the edges m into r
 *
 * Edges are sorted by receiver. A task owns a range of receivers with about the same number of edges as any other and goes
 * through them in tiles of MESSAGE_TILE edges, whose h, x and y stay in the second-level cache; while it multiplies, it fetches
 * the rows of P of the next tile. The mean is subtracted before squares are summed. Sums run in stored order and a row of a
 * product does not depend on its neighbours in a tile, so neither tiles, tasks, threads nor other scenes of a batch change a bit.
 *
 * Cost per edge: 2 (E H + H F + F F2) flops, a row of P read from anywhere in memory, rows of e, of Q and of the sum in order.
 * Memory: 3 tiles a thread and the packed weights.
 */
#include <math.h>

#include "ast.h"
#include "weight_panels.h"
#include "gemm.h"
#include "simd.h"

enum {
  MESSAGE_TILE = 96, /* edges; a multiple of GEMM_ROWS */
  MESSAGE_TASKS = 32,
  LEAST_EDGES = 2 * MESSAGE_TILE, /* of a task, even if that makes fewer of them, */
  MOST_EDGES = 16 * MESSAGE_TILE  /* or more */
};
static const float MESSAGE_EPS = 1e-5f;

typedef struct {
  const ast_message *s;
  int64_t row;           /* floats from one row of a tile to the next */
  dense_layer layers[6]; /* packed once a call: A1 with a1, A2, W2 with b2; for the gradients W2^T, A2^T, A1^T */
} message_weights;

enum { MESSAGE_A1, MESSAGE_A2, MESSAGE_W2, MESSAGE_W2_BACK, MESSAGE_A2_BACK, MESSAGE_A1_BACK };

static ast_status message_pack(const ast_message *s, bool gradients, message_weights *w) {
  *w = (message_weights){.s = s, .row = round_up(max64(s->H, max64(s->F, s->F2)), VW) + DENSE_APART};
  w->layers[MESSAGE_A1] = (dense_layer){.weight = s->A1, .row = 1, .column = s->E, .bias = s->a1, .K = s->E, .N = s->H};
  w->layers[MESSAGE_A2] = (dense_layer){.weight = s->A2, .row = 1, .column = s->H, .K = s->H, .N = s->F};
  w->layers[MESSAGE_W2] = (dense_layer){.weight = s->W2, .row = 1, .column = s->F, .bias = s->b2, .K = s->F, .N = s->F2};
  w->layers[MESSAGE_W2_BACK] = (dense_layer){.weight = s->W2, .row = s->F, .column = 1, .K = s->F2, .N = s->F};
  w->layers[MESSAGE_A2_BACK] = (dense_layer){.weight = s->A2, .row = s->H, .column = 1, .K = s->F, .N = s->H};
  w->layers[MESSAGE_A1_BACK] = (dense_layer){.weight = s->A1, .row = s->E, .column = 1, .K = s->H, .N = s->E};
  return dense_pack(w->layers, gradients ? 6 : 3, 6);
}

/* Whether the edge features are a share of the first layer, added as they are. */
AST_INLINE bool message_has_latents(const ast_message *s) { return s->E && !s->H; }

/* out = a layer on n rows of A, followed by ReLU or set to 0 where `hidden` is 0 */
static void message_layer(const message_weights *w, int layer, int64_t n, gemm_a a, dense_end end) {
  dense_rows(&w->layers[layer], 0, dense_panels(&w->layers[layer]), n, a, end);
}

typedef struct {
  float *h, *x, *y; /* [MESSAGE_TILE, row], their padding undefined */
  float *columns;   /* [4, row] */
} message_tile;

static bool message_new_tile(const message_weights *w, message_tile *t) {
  const int64_t size = MESSAGE_TILE * w->row;
  float *memory = ast_scratch(5, (3 * size + 4 * w->row) * (int64_t)sizeof *memory);
  *t = (message_tile){memory, memory + size, memory + 2 * size, memory + 3 * size};
  return memory != NULL;
}

/* One register tile of x: channels of panel p of the edges from m on. P + Q comes last: large values cost the product no digits.
 * Latents stand where the sums of the product would. */
AST_INLINE void message_first_tile(const int rows, const int vectors, const message_weights *w, int64_t p, int64_t m, const float *h,
                                   float *x) {
  const ast_message *s = w->s;
  const int64_t c = p * GEMM_COLUMNS, n = s->F - c;
  vf sum[GEMM_ROWS][2];
#pragma GCC unroll 12
  for (int i = 0; i < rows; i++) {
    const float *next = s->of_senders + s->senders[min64(m + i + MESSAGE_TILE, s->M - 1)] * s->F + c;
#pragma GCC unroll 2
    for (int v = 0; v < vectors; v++) {
      sum[i][v] = (vf){0};
      __builtin_prefetch(next + v * VW);
    }
  }
  if (message_has_latents(s)) {
    const float *e = s->edge_features + m * s->F + c;
#pragma GCC unroll 12
    for (int i = 0; i < rows; i++)
#pragma GCC unroll 2
      for (int v = 0; v < vectors; v++) sum[i][v] = vload_upto(e + i * s->F + v * VW, n - v * VW);
  }
  const dense_layer *l = &w->layers[MESSAGE_A2];
  if (s->H) dense_sums(rows, vectors, l, (gemm_a){h, w->row, 1}, l->panels + c * s->H, sum);
#pragma GCC unroll 12
  for (int i = 0; i < rows; i++) {
    const float *P = s->of_senders + s->senders[m + i] * s->F + c, *Q = s->of_receivers + s->receivers[m + i] * s->F + c;
#pragma GCC unroll 2
    for (int v = 0; v < vectors; v++) {
      const vf z = vload_upto(P + v * VW, n - v * VW) + vload_upto(Q + v * VW, n - v * VW) + sum[i][v];
      vstore(x + i * w->row + c + v * VW, vmax((vf){0}, z));
    }
  }
}

AST_INLINE void message_first_strip(const int vectors, const message_weights *w, int64_t p, int64_t first, int64_t n,
                                    const message_tile *t) {
  int64_t i = 0;
#define MESSAGE_STEP(rows) \
  for (; i + (rows) <= n; i += (rows)) message_first_tile(rows, vectors, w, p, first + i, t->h + i * w->row, t->x + i * w->row)
  MESSAGE_STEP(GEMM_ROWS);
  if (GEMM_ROWS > 8) MESSAGE_STEP(8);
  MESSAGE_STEP(4);
  MESSAGE_STEP(2);
  MESSAGE_STEP(1);
#undef MESSAGE_STEP
}

/* h, x and y of edges first to first + n */
static void message_layers(const message_weights *w, int64_t first, int64_t n, const message_tile *t) {
  const ast_message *s = w->s;
  const gemm_a e = {s->edge_features + first * s->E, s->E, 1};
  message_layer(w, MESSAGE_A1, n, e, (dense_end){.activation = AST_RELU, .out = t->h, .out_row = w->row});
  for (int64_t p = 0; p * GEMM_COLUMNS < s->F; p++) {
    if (s->F - p * GEMM_COLUMNS > VW) message_first_strip(2, w, p, first, n, t);
    else message_first_strip(1, w, p, first, n, t);
  }
  message_layer(w, MESSAGE_W2, n, (gemm_a){t->x, w->row, 1}, (dense_end){.out = t->y, .out_row = w->row});
}

/* Subtracts the mean from y, padded with zeros then; returns 1 / sqrt(variance + eps). */
AST_INLINE float message_center(int64_t F2, float *y) {
  vf total = {0}, squares = {0};
  for (int64_t c = 0; c < F2; c += VW) total += vload_upto(y + c, F2 - c);
  const float mean = vsum(total) / (float)F2;
  for (int64_t c = 0; c < F2; c += VW) {
    vf x = vload(y + c) - mean;
    if (c + VW > F2) x = (vf)((vi)x & (LANE_INDICES < (int32_t)(F2 - c)));
    vstore(y + c, x);
    squares += x * x;
  }
  return 1 / sqrtf(vsum(squares) / (float)F2 + MESSAGE_EPS);
}

/* ---- forward ---- */

typedef struct {
  message_weights w;
  int64_t tasks;
  float *sum, *messages;
} message_job;

/* The first receiver whose edges start at `edge` or later. */
static int64_t first_receiver(const ast_message *s, int64_t edge) {
  int64_t begin = 0, end = s->R;
  while (begin < end) {
    const int64_t middle = begin + (end - begin) / 2;
    if (s->receiver_offsets[middle] < edge) begin = middle + 1;
    else end = middle;
  }
  return begin;
}

static void message_out(const message_job *job, int64_t m, float *y) {
  const ast_message *s = job->w.s;
  const int64_t F2 = s->F2;
  const float inverse = message_center(F2, y);
  float *sum = job->sum + s->receivers[m] * F2;
  for (int64_t c = 0; c < F2; c += VW) {
    const int64_t n = F2 - c;
    const vf out = vload(y + c) * inverse * vload_upto(s->gamma + c, n) + vload_upto(s->beta + c, n);
    vstore_upto(sum + c, vload_upto(sum + c, n) + out, n);
    if (job->messages) vstore_upto(job->messages + m * F2 + c, out, n);
  }
}

static ast_status message_task(int64_t index, void *context) {
  const message_job *job = context;
  const ast_message *s = job->w.s;
  const int64_t begin = first_receiver(s, index * s->M / job->tasks);
  const int64_t end = index + 1 < job->tasks ? first_receiver(s, (index + 1) * s->M / job->tasks) : s->R;
  const int64_t last = s->receiver_offsets[end];
  message_tile t;
  if (!message_new_tile(&job->w, &t)) return AST_NO_MEMORY;
  memset(job->sum + begin * s->F2, 0, (size_t)((end - begin) * s->F2) * sizeof *job->sum);
  for (int64_t m = s->receiver_offsets[begin]; m < last; m += MESSAGE_TILE) {
    const int64_t n = min64(MESSAGE_TILE, last - m);
    message_layers(&job->w, m, n, &t);
    for (int64_t i = 0; i < n; i++) message_out(job, m + i, t.y + i * job->w.row);
  }
  return AST_OK;
}

static ast_status message(const ast_message *s, float *restrict sum, float *restrict messages) {
  message_job job = {.sum = sum, .messages = messages};
  const ast_status status = message_pack(s, false, &job.w);
  if (status != AST_OK) return status;
  const int64_t edges = min64(MOST_EDGES, max64(LEAST_EDGES, s->M / MESSAGE_TASKS));
  job.tasks = max64(1, (s->M + edges - 1) / edges);
  return ast_parallel(job.tasks, message_task, &job);
}
