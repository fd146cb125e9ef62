/* Message passing over the edges of a graph, fused: no array of the width of a feature is written per edge.
 *
 *   h_m = relu(A1 e_m + a1)                  the edge encoder, absent if H = 0
 *   x_m = relu(P_s(m) + Q_r(m) + A2 h_m)     the first layer; P and Q are its products with senders and receivers
 *   x_m = relu(P_s(m) + Q_r(m) + e_m)        or this; e_m, of F channels, is its product with latents of the edges
 *   y_m = W2 x_m + b2                        the second layer
 *   out_m = gamma (y_m - mean y_m) / sqrt(var y_m + eps) + beta
 *   sum_r = sum of out_m over the edges m into r
 *
 * Edges are sorted by receiver. A task owns a range of receivers with about the same number of edges as any other and
 * goes through them in tiles of MESSAGE_TILE edges, whose h, x and y stay in the second-level cache; while it
 * multiplies, it fetches the rows of P of the next tile. Sums run in stored order, by chains of MESSAGE_CHAIN edges of
 * a receiver, and a row of a product does not depend on its neighbours in a tile, so neither tiles, tasks, threads nor
 * other scenes of a batch change a bit.
 *
 * Cost per edge: 2 (E H + H F + F F2) flops, a row of P read from anywhere in memory, rows of e, of Q and of the sum in
 * order. Memory: 3 tiles a thread and the packed weights.
 */
#include "weight_panels.h"
#include "norm.h"

enum {
  MESSAGE_TILE = 96,   /* edges; a multiple of GEMM_ROWS */
  MESSAGE_CHAIN = 256, /* edges of one chain of a sum at most: its rounding errors grow with their number */
  MESSAGE_TASKS = 32,
  LEAST_EDGES = 2 * MESSAGE_TILE, /* of a task, even if that makes fewer of them, */
  MOST_EDGES = 16 * MESSAGE_TILE  /* or more */
};

typedef struct {
  const ast_message *step;
  int64_t row;           /* floats from one row of a tile to the next */
  dense_layer layers[6]; /* packed once a call: A1 with a1, A2, W2 with b2; for the gradients W2^T, A2^T, A1^T */
} message_weights;

enum { MESSAGE_A1, MESSAGE_A2, MESSAGE_W2, MESSAGE_W2_BACK, MESSAGE_A2_BACK, MESSAGE_A1_BACK };

static ast_status message_pack(const ast_message *step, bool gradients, message_weights *w) {
  *w = (message_weights){.step = step, .row = round_up(max64(step->H, max64(step->F, step->F2)), VW) + DENSE_APART};
  w->layers[MESSAGE_A1] = dense_forward(step->A1, step->a1, step->E, step->H);
  w->layers[MESSAGE_A2] = dense_forward(step->A2, NULL, step->H, step->F);
  w->layers[MESSAGE_W2] = dense_forward(step->W2, step->b2, step->F, step->F2);
  w->layers[MESSAGE_W2_BACK] = dense_backward(step->W2, step->F, step->F2, step->F);
  w->layers[MESSAGE_A2_BACK] = dense_backward(step->A2, step->H, step->F, step->H);
  w->layers[MESSAGE_A1_BACK] = dense_backward(step->A1, step->E, step->H, step->E);
  return dense_pack(w->layers, gradients ? 6 : 3);
}

/* Whether the edge features are products with the first layer already, added as they are. */
AST_INLINE bool message_has_latents(const ast_message *step) { return step->E && !step->H; }

typedef struct {
  float *h, *x, *y; /* [MESSAGE_TILE, row], their padding undefined */
  norm_columns columns;
} message_tile;

static bool message_new_tile(const message_weights *w, message_tile *t) {
  const int64_t size = MESSAGE_TILE * w->row;
  float *memory = ast_scratch((3 * size + NORM_COLUMNS * w->row) * (int64_t)sizeof *memory);
  if (!memory) return false;
  *t = (message_tile){memory, memory + size, memory + 2 * size, norm_new_columns(memory + 3 * size, w->row)};
  return true;
}

/* One register tile of x: channels of panel p of the edges from the i0-th of a block on. P + Q comes last: large values
 * cost the product no digits. Latents stand where the sums of the product would. */
AST_INLINE void message_first_tile(const int rows, const int vectors, const message_weights *w,
                                   const dense_block *block, int64_t p, int64_t first, int64_t i0, float *x) {
  const ast_message *s = w->step;
  const int64_t c = p * GEMM_COLUMNS, n = s->F - c, m = first + i0;
  vf sum[GEMM_ROWS][2];
  EACH(rows, i) {
    const float *next = s->of_senders + s->senders[min64(m + i + MESSAGE_TILE, s->M - 1)] * s->F + c;
    EACH(vectors, v) {
      sum[i][v] = (vf){0};
      __builtin_prefetch(next + v * VW);
    }
  }
  if (message_has_latents(s)) {
    const float *e = s->edge_features + m * s->F + c;
    TILE_EACH(i, v) sum[i][v] = vload_upto(e + i * s->F + v * VW, n - v * VW);
  }
  if (s->H) dense_sums(rows, vectors, block, p, i0, sum);
  EACH(rows, i) {
    const float *P = s->of_senders + s->senders[m + i] * s->F + c,
                *Q = s->of_receivers + s->receivers[m + i] * s->F + c;
    EACH(vectors, v) {
      const vf z = vload_upto(P + v * VW, n - v * VW) + vload_upto(Q + v * VW, n - v * VW) + sum[i][v];
      vstore(x + i * w->row + c + v * VW, vmax((vf){0}, z));
    }
  }
}

AST_INLINE void message_first_strip(const int vectors, const message_weights *w, const dense_block *block, int64_t p,
                                    int64_t first, int64_t n, const message_tile *t) {
#define FIRST_TILE(rows) message_first_tile(rows, vectors, w, block, p, first, i, t->x + i * w->row)
  EACH_TILE_OF_ROWS(i, n, FIRST_TILE);
#undef FIRST_TILE
}

/* h, x and y of edges first to first + n */
static void message_layers(const message_weights *w, int64_t first, int64_t n, const message_tile *t) {
  const ast_message *step = w->step;
  const gemm_a e = {step->edge_features + first * step->E, step->E, 1};
  dense_all(&w->layers[MESSAGE_A1], n, e, (dense_end){.activation = AST_RELU, .out = t->h, .out_row = w->row});
  dense_block block;
  dense_new_block(&block, &w->layers[MESSAGE_A2], (gemm_a){t->h, w->row, 1}, n);
  for (int64_t p = 0; p * GEMM_COLUMNS < step->F; p++) {
    if (step->H) dense_begin_panel(&block, p);
    if (step->F - p * GEMM_COLUMNS > VW) message_first_strip(2, w, &block, p, first, n, t);
    else message_first_strip(1, w, &block, p, first, n, t);
  }
  dense_all(&w->layers[MESSAGE_W2], n, (gemm_a){t->x, w->row, 1}, (dense_end){.out = t->y, .out_row = w->row});
}

static void message_end_chain(int64_t n, float *restrict chain, float *restrict sum) {
  for (int64_t c = 0; c < n; c++) sum[c] += chain[c], chain[c] = 0;
}

/* A sum of n channels over more than MESSAGE_CHAIN edges goes chain by chain, their sums again by chains of that many:
 * chains [2,n] hold what is not added so far. This comes behind the edge `done` of `all`, counted from 1. */
AST_INLINE void message_end_chains(int64_t done, int64_t all, int64_t n, float *chains, float *sum) {
  if (done % MESSAGE_CHAIN && done < all) return;
  message_end_chain(n, chains, chains + n);
  if (done % (MESSAGE_CHAIN * MESSAGE_CHAIN) == 0 || done == all) message_end_chain(n, chains + n, sum);
}

/* ---- forward ---- */

typedef struct {
  message_weights w;
  int64_t tasks;
  float *sum, *messages;
} message_job;

/* The messages of edges first.., from y, and the sums of their receivers, with the chains of one with many edges. */
AST_INLINE void message_out(const message_job *job, int64_t first, int64_t n, float *y, float *chains,
                            const bool whole) {
  const ast_message *step = job->w.step;
  const int64_t F2 = step->F2;
  for (int64_t m = first; m < first + n; m++, y += job->w.row) {
    const float scale = norm_centre(y, F2, whole);
    const int64_t *offsets = step->receiver_offsets + step->receivers[m], edges = offsets[1] - offsets[0];
    float *total = job->sum + step->receivers[m] * F2, *sum = edges > MESSAGE_CHAIN ? chains : total;
    for (int64_t c = 0; c < F2; c += VW) {
      const int64_t lanes = whole ? VW : F2 - c;
      const vf out = norm_out(scale * vload(y + c), step->gamma, step->beta, c, lanes);
      vstore_upto(sum + c, vload_upto(sum + c, lanes) + out, lanes);
      if (job->messages) vstore_upto(job->messages + m * F2 + c, out, lanes);
    }
    if (sum == chains) message_end_chains(m + 1 - offsets[0], edges, F2, chains, total);
  }
}

static ast_status message_task(int64_t index, void *context) {
  const message_job *job = context;
  const ast_message *step = job->w.step;
  const int64_t begin = lower_bound(step->receiver_offsets, 0, step->R, index * step->M / job->tasks);
  const int64_t end = index + 1 < job->tasks
                          ? lower_bound(step->receiver_offsets, begin, step->R, (index + 1) * step->M / job->tasks)
                          : step->R;
  const int64_t last = step->receiver_offsets[end];
  message_tile t;
  float *chains = ast_scratch(2 * step->F2 * (int64_t)sizeof *chains);
  if (!chains || !message_new_tile(&job->w, &t)) return AST_NO_MEMORY;
  memset(chains, 0, (size_t)(2 * step->F2) * sizeof *chains);
  memset(job->sum + begin * step->F2, 0, (size_t)((end - begin) * step->F2) * sizeof *job->sum);
  for (int64_t m = step->receiver_offsets[begin]; m < last; m += MESSAGE_TILE) {
    const int64_t n = min64(MESSAGE_TILE, last - m);
    message_layers(&job->w, m, n, &t);
    if (step->F2 % VW) message_out(job, m, n, t.y, chains, false);
    else message_out(job, m, n, t.y, chains, true);
  }
  return AST_OK;
}

static ast_status message(const ast_message *step, float *restrict sum, float *restrict messages) {
  AST_SCRATCH_SCOPE;
  message_job job = {.sum = sum, .messages = messages};
  const ast_status status = message_pack(step, false, &job.w);
  if (status != AST_OK) return status;
  const int64_t edges = min64(MOST_EDGES, max64(LEAST_EDGES, step->M / MESSAGE_TASKS));
  job.tasks = max64(1, divide_up(step->M, edges));
  return ast_parallel(job.tasks, message_task, &job);
}
