/* Message passing over the edges of a graph, fused: no array of the width of a feature is written per edge.
 *
 *   h_m = relu(A1 e_m + a1)                          edge encoder, absent if H = 0
 *   z_m = P_s(m) + Q_r(m) + A2 h_m                   first layer; P and Q are its products with senders and receivers
 *   y_m = W2 relu(z_m) + b2                          second layer
 *   out_m = gamma (y_m - mean y_m) / sqrt(var y_m + eps) + beta,     sum_r = sum of out_m over the edges m into r
 *
 * Edges are sorted by receiver. A task owns a range of receivers with about the same number of edges as any other and goes
 * through them in tiles of MESSAGE_TILE edges, whose h, relu(z) and y stay in the second-level cache. The mean is subtracted
 * before squares are summed. Sums run in stored order and a row of a product does not depend on its neighbours in a tile, so
 * neither tiles, tasks, threads nor the other scenes of a batch change a bit.
 *
 * Cost per edge: 2 (E H + H F + F F2) flops, a row of P read from anywhere in memory, rows of Q and of the sum in order.
 * Memory: 3 tiles a thread and the packed weights.
 */
#include <math.h>

#include "ast.h"
#include "gemm.h"
#include "simd.h"

enum {
  MESSAGE_TILE = 96,
  LEAST_EDGES = 2 * MESSAGE_TILE, /* a task, unless that leaves too few tasks to balance */
  MOST_EDGES = 16 * MESSAGE_TILE,
  MESSAGE_TASKS = 8, /* so many at least, if there are edges enough for one tile each */
};
static const float MESSAGE_EPS = 1e-5f;

/* Channels c to c + VW of a row of `width` floats without padding; beyond its end 0 is read and nothing written. */
AST_INLINE vf message_load(const float *row, int64_t c, int64_t width) {
  return c + VW <= width ? vload(row + c) : vload_part(row + c, width - c);
}
AST_INLINE void message_store(float *row, int64_t c, int64_t width, vf x) {
  if (c + VW <= width) vstore(row + c, x);
  else vstore_part(row + c, x, width - c);
}
AST_INLINE vf message_relu(vf x) { return vselect(x < 0, (vf){0}, x); } /* keeps NaN */

/* The weights as the products read them, once a call: matrices in panels, vectors padded with zeros to whole vectors. */
typedef struct {
  const ast_message *s;
  int64_t row; /* floats from one row of a tile to the next: seldom a power of two, which would crowd few cache sets */
  float *A1, *A2, *W2;
  float *a1, *b2, *gamma, *beta;
} message_weights;

static float *message_place(float **to, float *memory, int64_t size) {
  *to = memory;
  return memory + round_up(size, 16);
}

static void message_pad(const float *from, int64_t n, float *to) {
  memcpy(to, from, (size_t)n * sizeof *to);
  memset(to + n, 0, (size_t)(round_up(n, VW) - n) * sizeof *to);
}

/* Floats that message_pack needs. */
static int64_t message_packed_size(const ast_message *s) {
  return gemm_packed_size(s->E, s->H) + gemm_packed_size(s->H, s->F) + gemm_packed_size(s->F, s->F2) + s->H + 3 * s->F2 + 7 * 16 + 4 * VW;
}

static message_weights message_pack(const ast_message *s, float *memory) {
  message_weights w = {.s = s, .row = round_up(max64(s->H, max64(s->F, s->F2)), VW) + 16};
  memory = message_place(&w.A1, memory, gemm_packed_size(s->E, s->H));
  memory = message_place(&w.A2, memory, gemm_packed_size(s->H, s->F));
  memory = message_place(&w.W2, memory, gemm_packed_size(s->F, s->F2));
  memory = message_place(&w.a1, memory, round_up(s->H, VW));
  memory = message_place(&w.b2, memory, round_up(s->F2, VW));
  memory = message_place(&w.gamma, memory, round_up(s->F2, VW));
  message_place(&w.beta, memory, round_up(s->F2, VW));
  gemm_pack(s->A1, 1, s->E, s->E, s->H, w.A1);
  gemm_pack(s->A2, 1, s->H, s->H, s->F, w.A2);
  gemm_pack(s->W2, 1, s->F, s->F, s->F2, w.W2);
  message_pad(s->a1, s->H, w.a1);
  message_pad(s->b2, s->F2, w.b2);
  message_pad(s->gamma, s->F2, w.gamma);
  message_pad(s->beta, s->F2, w.beta);
  return w;
}

typedef struct {
  float *h, *x, *y; /* [MESSAGE_TILE, row]: the encoder's hidden layer, relu(z), and W2 relu(z) without b2; 4 rows behind it */
} message_tile;

static bool message_new_tile(const message_weights *w, message_tile *t) {
  const int64_t size = MESSAGE_TILE * w->row;
  float *memory = ast_scratch(5, (3 * size + 4 * w->row) * (int64_t)sizeof *memory);
  *t = (message_tile){memory, memory + size, memory + 2 * size};
  return memory != NULL;
}

/* x = relu(z): P_s + Q_r added to the product in x if there is one */
AST_INLINE void message_gather(const message_weights *w, int64_t first, int64_t n, int64_t ahead, bool add, float *tile) {
  const ast_message *s = w->s;
  for (int64_t i = 0; i < n; i++) {
    const float *P = s->of_senders + s->senders[first + i] * s->F, *Q = s->of_receivers + s->receivers[first + i] * s->F;
    float *x = tile + i * w->row;
    for (int64_t c = 0; c < s->F; c += VW) {
      const vf z = message_load(P, c, s->F) + message_load(Q, c, s->F);
      vstore(x + c, message_relu(add ? vload(x + c) + z : z));
    }
  }
  for (int64_t i = 0; i < ahead; i++) {
    const float *next = s->of_senders + s->senders[first + n + i] * s->F;
    for (int64_t c = 0; c < s->F; c += 16) __builtin_prefetch(next + c);
  }
}

/* All layers of edges first to first + n; `ahead` edges follow them, whose senders are prefetched. */
static void message_layers(const message_weights *w, int64_t first, int64_t n, int64_t ahead, const message_tile *t) {
  const ast_message *s = w->s;
  const int64_t H = round_up(s->H, VW), F = round_up(s->F, VW), F2 = round_up(s->F2, VW), row = w->row;
  if (H) {
    gemm(n, H, s->E, (gemm_a){s->edge_features + first * s->E, s->E, 1}, gemm_packed(w->A1, s->E), t->h, row, false);
    for (int64_t i = 0; i < n; i++)
      for (int64_t c = 0; c < H; c += VW) vstore(t->h + i * row + c, message_relu(vload(t->h + i * row + c) + vload(w->a1 + c)));
    gemm(n, F, s->H, (gemm_a){t->h, row, 1}, gemm_packed(w->A2, s->H), t->x, row, false);
    message_gather(w, first, n, ahead, true, t->x);
  } else {
    message_gather(w, first, n, ahead, false, t->x);
  }
  gemm(n, F2, s->F, (gemm_a){t->x, row, 1}, gemm_packed(w->W2, s->F), t->y, row, false);
}

/* y + b2 minus its mean in place, padding excepted; returns 1 / sqrt(variance + eps). */
AST_INLINE float message_center(const message_weights *w, float *y) {
  const int64_t F2 = w->s->F2;
  vf total = {0}, squares = {0}, mean;
  for (int64_t c = 0; c < F2; c += VW) {
    const vf x = vload(y + c) + vload(w->b2 + c);
    vstore(y + c, x);
    total += x;
  }
  mean = vsplat(vsum(total) / (float)F2);
  for (int64_t c = 0; c < F2; c += VW) {
    if (c + VW > F2) { /* what pads the last vector stays 0 */
      vf part = {0};
      memcpy(&part, &mean, (size_t)(F2 - c) * sizeof(float));
      mean = part;
    }
    const vf x = vload(y + c) - mean;
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
  const message_weights *w = &job->w;
  const int64_t F2 = w->s->F2;
  const float inverse = message_center(w, y);
  float *sum = job->sum + w->s->receivers[m] * F2;
  for (int64_t c = 0; c < F2; c += VW) {
    const vf out = vload(y + c) * inverse * vload(w->gamma + c) + vload(w->beta + c);
    message_store(sum, c, F2, message_load(sum, c, F2) + out);
    if (job->messages) message_store(job->messages + m * F2, c, F2, out);
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
    const int64_t n = min64(MESSAGE_TILE, last - m), ahead = min64(MESSAGE_TILE, last - m - n);
    message_layers(&job->w, m, n, ahead, &t);
    for (int64_t i = 0; i < n; i++) message_out(job, m + i, t.y + i * job->w.row);
  }
  return AST_OK;
}

static ast_status message(const ast_message *s, float *restrict sum, float *restrict messages) {
  float *memory = ast_scratch(6, message_packed_size(s) * (int64_t)sizeof *memory);
  if (!memory) return AST_NO_MEMORY;
  const int64_t edges = min64(MOST_EDGES, max64(LEAST_EDGES, s->M / MESSAGE_TASKS));
  message_job job = {message_pack(s, memory), max64(1, s->M / edges), sum, messages};
  return ast_parallel(job.tasks, message_task, &job);
}
