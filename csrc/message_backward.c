/* Gradients of message passing (message.c), its layers recomputed tile by tile. With g_m = dsum_r(m) + dout_m,
 * u_m = (y_m - mean) / sd and <.> the mean over channels:
 *
 *   dgamma = sum_m g_m u_m,   dbeta = sum_m g_m,   p_m = gamma g_m,   dy_m = (p_m - <p_m> - u_m <p_m u_m>) / sd_m
 *   dW2 = sum_m dy_m x_m^T,   db2 = sum_m dy_m,   dz_m = (z_m > 0) W2^T dy_m,         x_m = relu(z_m)
 *   dA2 = sum_m dz_m h_m^T,   dc_m = (h_m > 0) A2^T dz_m,   dA1 = sum_m dc_m e_m^T,   da1 = sum_m dc_m,   de_m = A1^T
 * dc_m de_m = dz_m                                                                       where e_m is added as it is
 *   dP_s = sum of dz_m over the edges from step,   dQ_r = sum of dz_m over the edges into r
 *
 * Edges come in rounds. First the tasks of a round, each a run of tiles, put dz into a buffer and add to weight
 * gradients of their own, of which there are at most ROUND_TASKS. Then other tasks add the rows of the buffer to dQ,
 * each for a run of receivers, and to dP, each for the senders with the same index modulo PARTS. All go through their
 * edges in stored order, so that each sum runs in stored order whatever the rounds, tasks, threads and other scenes. At
 * the end the weight gradients of the tasks are added up in order.
 *
 * Cost per edge: the forward flops again, and twice as many for the two products per layer (but E H once, unless de is
 * wanted). Memory: at most ROUND_TASKS sums of weight gradients and ROUND_TASKS * TASK_TILES * MESSAGE_TILE rows of dz,
 * 11 MB at 128 channels.
 */
#include "ast.h"
#include "weight_panels.h"
#include "gemm.h"
#include "simd.h"

enum {
  ROUND_TASKS = 16,
  TASK_TILES = 10, /* of a task of a round */
  PARTS = 8,
  ROWS_AHEAD = 6 /* edges by which prefetching runs ahead */
};

/* The gradients that are sums over all edges, as tiles add to them. */
typedef struct {
  float *W2, *A2, *A1; /* [F2, F], [F, H] and, transposed, [E, H], rows padded to whole vectors */
  float *b2, *gamma, *beta, *a1, *end;
} message_sums;

typedef struct {
  message_weights w;
  const float *dsum, *dmessages;
  const ast_message_gradients *out;
  float *dz;                  /* of the edges of this round, rows w.row apart */
  float *partials;            /* the sums of each task of a round */
  int64_t *part_offsets;      /* [tasks, PARTS + 1] places in by_part */
  int32_t *by_part;           /* the edges of each task, less `begin`, by the part of their sender */
  int64_t size, tasks, edges; /* floats of the sums of a task; tasks of a round; edges of a task */
  int64_t begin, end;         /* the edges of this round */
} message_backward_job;

static int64_t message_sums_size(const ast_message *step) {
  const int64_t H = round_up(step->H, VW), F = round_up(step->F, VW), F2 = round_up(step->F2, VW);
  return round_up(step->F2 * F + step->F * H + step->E * H + 3 * F2 + H, 16);
}

static message_sums message_sums_at(const ast_message *step, float *memory) {
  const int64_t H = round_up(step->H, VW), F = round_up(step->F, VW), F2 = round_up(step->F2, VW);
  message_sums sums = {.W2 = memory};
  sums.A2 = sums.W2 + step->F2 * F;
  sums.A1 = sums.A2 + step->F * H;
  sums.b2 = sums.A1 + step->E * H;
  sums.gamma = sums.b2 + F2;
  sums.beta = sums.gamma + F2;
  sums.a1 = sums.beta + F2;
  sums.end = sums.a1 + H;
  return sums;
}

/* Sorts the edges of a task by the part of their sender, in stored order within each. */
static void message_sort_by_part(const message_backward_job *job, int64_t begin, int64_t end, int64_t *part_offsets) {
  const int64_t *senders = job->w.step->senders;
  int64_t next[PARTS] = {0};
  for (int64_t m = begin; m < end; m++) next[senders[m] % PARTS]++;
  part_offsets[0] = begin - job->begin;
  for (int64_t p = 0; p < PARTS; p++) {
    part_offsets[p + 1] = part_offsets[p] + next[p];
    next[p] = part_offsets[p];
  }
  for (int64_t m = begin; m < end; m++) job->by_part[next[senders[m] % PARTS]++] = (int32_t)(m - job->begin);
}

/* y becomes dy. Sums over the tile are added to those of the task at its end: shorter sums are more exact. */
AST_INLINE void message_norm_backward(const message_backward_job *job, int64_t first, int64_t n, const message_tile *t,
                                      const message_sums *sums, const bool whole) {
  const ast_message *step = job->w.step;
  const int64_t F2 = step->F2, row = job->w.row;
  memset(t->columns.dgamma, 0, (size_t)row * sizeof(float));
  memset(t->columns.dbeta, 0, (size_t)row * sizeof(float));
  for (int64_t i = 0; i < n; i++) {
    float *y = t->y + i * row;
    const float *dmessage = job->dmessages ? job->dmessages + (first + i) * F2 : NULL;
    const float scale = norm_centre(y, F2, whole);
    norm_backward(F2, whole, step->gamma, job->dsum + step->receivers[first + i] * F2, dmessage, scale, NULL, y,
                  &t->columns);
  }
  dense_add_rows(t->columns.dgamma, 0, 1, F2, sums->gamma);
  dense_add_rows(t->columns.dbeta, 0, 1, F2, sums->beta);
  dense_add_rows(t->y, row, n, F2, sums->b2);
}

/* dz of the tile into the buffer, and the weight gradients added to `sums`, or put there if they are `fresh`. */
static void message_tile_backward(const message_backward_job *job, int64_t first, int64_t n, bool fresh,
                                  const message_tile *t, const message_sums *sums) {
  const message_weights *w = &job->w;
  const ast_message *step = w->step;
  const int64_t H = round_up(step->H, VW), F = round_up(step->F, VW), E = step->E, row = w->row;
  float *dz = job->dz + (first - job->begin) * row, *dy = t->y, *dc = t->y;
  message_layers(w, first, n, t);
  if (step->F2 % VW) message_norm_backward(job, first, n, t, sums, false);
  else message_norm_backward(job, first, n, t, sums, true);
  /* forward: y = W2 x + b2, so dW2 = dy x^T and dx = W2^T dy */
  gemm(step->F2, F, n, (gemm_a){dy, 1, row}, t->x, row, sums->W2, F, !fresh);
  dense_all(&w->layers[MESSAGE_W2_BACK], n, (gemm_a){dy, row, 1},
            (dense_end){.out = dz, .out_row = row, .hidden = t->x, .hidden_row = row});
  /* forward: x = relu(P + Q + e), so de = dz */
  float *de = job->out->edge_features;
  for (int64_t i = 0; de && message_has_latents(step) && i < n; i++)
    memcpy(de + (first + i) * E, dz + i * row, (size_t)E * sizeof *de);
  if (!H) return;
  /* forward: x = relu(P + Q + A2 h), so dA2 = dz h^T and dh = A2^T dz */
  gemm(step->F, H, n, (gemm_a){dz, 1, row}, t->h, row, sums->A2, H, !fresh);
  dense_all(&w->layers[MESSAGE_A2_BACK], n, (gemm_a){dz, row, 1},
            (dense_end){.out = dc, .out_row = row, .hidden = t->h, .hidden_row = row});
  /* forward: h = relu(A1 e + a1), so da1 = dc, dA1 = dc e^T and de = A1^T dc */
  dense_add_rows(dc, row, n, step->H, sums->a1);
  gemm(E, H, n, (gemm_a){step->edge_features + first * E, 1, E}, dc, row, sums->A1, H, !fresh);
  if (de)
    dense_all(&w->layers[MESSAGE_A1_BACK], n, (gemm_a){dc, row, 1}, (dense_end){.out = de + first * E, .out_row = E});
}

static ast_status message_backward_task(int64_t index, void *context) {
  const message_backward_job *job = context;
  const int64_t begin = job->begin + index * job->edges, end = min64(job->end, begin + job->edges);
  const message_sums sums = message_sums_at(job->w.step, job->partials + index * job->size);
  message_tile t;
  if (!message_new_tile(&job->w, &t)) return AST_NO_MEMORY;
  if (!job->begin) memset(sums.b2, 0, (size_t)(sums.end - sums.b2) * sizeof *sums.b2);
  message_sort_by_part(job, begin, end, job->part_offsets + index * (PARTS + 1));
  for (int64_t m = begin; m < end; m += MESSAGE_TILE)
    message_tile_backward(job, m, min64(MESSAGE_TILE, end - m), m == index * job->edges, &t, &sums);
  return AST_OK;
}

/* forward: z += P[sender] + Q[receiver] */
AST_INLINE void message_add_row(int64_t F, const float *dz, float *to) {
  for (int64_t c = 0; c < F; c += VW) vstore_upto(to + c, vload_upto(to + c, F - c) + vload(dz + c), F - c);
}

/* dP of the senders of a part; the first round clears them before. */
static void message_add_to_senders(const message_backward_job *job, int64_t part) {
  const ast_message *step = job->w.step;
  const int64_t F = step->F, *senders = step->senders + job->begin;
  for (int64_t r = part; !job->begin && r < step->S; r += PARTS)
    memset(job->out->of_senders + r * F, 0, (size_t)F * sizeof(float));
  for (int64_t task = 0; task * job->edges < job->end - job->begin; task++) {
    const int64_t *offsets = job->part_offsets + task * (PARTS + 1), last = offsets[part + 1];
    for (int64_t i = offsets[part]; i < last; i++) {
      const int32_t ahead = job->by_part[min64(i + ROWS_AHEAD, last - 1)];
      for (int64_t c = 0; c < F; c += 16) {
        __builtin_prefetch(job->dz + ahead * job->w.row + c);
        __builtin_prefetch(job->out->of_senders + senders[ahead] * F + c, 1);
      }
      const int32_t m = job->by_part[i];
      message_add_row(F, job->dz + m * job->w.row, job->out->of_senders + senders[m] * F);
    }
  }
}

/* dQ of the receivers whose first edge is in a part of this round, in the last part of all of those behind it, too, and
 * in the first part of that whose edges the round before has begun. */
static void message_add_to_receivers(const message_backward_job *job, int64_t part) {
  const ast_message *step = job->w.step;
  const int64_t F = step->F, edges = job->end - job->begin, *offsets = step->receiver_offsets;
  int64_t r = lower_bound(offsets, 0, step->R, job->begin + part * edges / PARTS);
  int64_t end = lower_bound(offsets, r, step->R, job->begin + (part + 1) * edges / PARTS);
  if (part == 0 && job->begin) r--;
  if (part + 1 == PARTS && job->end == step->M) end = step->R;
  for (; r < end; r++) {
    float *dQ = job->out->of_receivers + r * F;
    if (offsets[r] >= job->begin) memset(dQ, 0, (size_t)F * sizeof *dQ);
    for (int64_t m = max64(offsets[r], job->begin); m < min64(offsets[r + 1], job->end); m++)
      message_add_row(F, job->dz + (m - job->begin) * job->w.row, dQ);
  }
}

static ast_status message_rows_task(int64_t index, void *context) {
  if (index < PARTS) message_add_to_senders(context, index);
  else message_add_to_receivers(context, index - PARTS);
  return AST_OK;
}

/* ---- all rounds ---- */

static ast_status message_rounds(message_backward_job *job) {
  const ast_message *step = job->w.step;
  ast_status status = AST_OK;
  do { /* once even without edges, to clear dP and dQ */
    job->end = min64(step->M, job->begin + job->tasks * job->edges);
    const int64_t tasks = divide_up(job->end - job->begin, job->edges);
    status = ast_parallel(tasks, message_backward_task, job);
    if (status == AST_OK) status = ast_parallel(2 * PARTS, message_rows_task, job);
    job->begin = job->end;
  } while (status == AST_OK && job->begin < step->M);
  return status;
}

/* The sum over the tasks, dA1 by way of its transpose. */
static ast_status message_add_partials(const message_backward_job *job, float *dA1) {
  const ast_message *step = job->w.step;
  const ast_message_gradients *out = job->out;
  const message_sums at = message_sums_at(step, job->partials);
  const int64_t H = round_up(step->H, VW), F = round_up(step->F, VW);
  const dense_sum sums[] = {
      {out->W2, at.W2 - job->partials, step->F2, step->F, F}, {out->A2, at.A2 - job->partials, step->F, step->H, H},
      {dA1, at.A1 - job->partials, step->E, step->H, H},      {out->b2, at.b2 - job->partials, 1, step->F2, 0},
      {out->gamma, at.gamma - job->partials, 1, step->F2, 0}, {out->beta, at.beta - job->partials, 1, step->F2, 0},
      {out->a1, at.a1 - job->partials, 1, step->H, 0},
  };
  const ast_status status = dense_add_partials((dense_sum_job){job->partials, job->size, job->tasks, sums, 7});
  for (int64_t h = 0; status == AST_OK && h < step->H; h++)
    for (int64_t i = 0; i < step->E; i++) out->A1[h * step->E + i] = dA1[i * step->H + h];
  return status;
}

static ast_status message_backward(const ast_message *step, const float *restrict dsum, const float *restrict dmessages,
                                   const ast_message_gradients *out) {
  AST_SCRATCH_SCOPE;
  message_backward_job job = {.dsum = dsum, .dmessages = dmessages, .out = out, .size = message_sums_size(step)};
  ast_status status = message_pack(step, true, &job.w);
  if (status != AST_OK) return status;
  const int64_t tiles = max64(1, divide_up(step->M, MESSAGE_TILE)), most = ROUND_TASKS * TASK_TILES,
                rounds = divide_up(tiles, most);
  const int64_t of_round = divide_up(tiles, rounds), of_task = divide_up(of_round, ROUND_TASKS);
  job.edges = MESSAGE_TILE * of_task;
  job.tasks = divide_up(of_round, of_task);

  const int64_t round = job.tasks * job.edges, partials = job.tasks * job.size, dz = round * job.w.row,
                dA1 = step->E * step->H;
  const int64_t offsets = round_up(job.tasks * (PARTS + 1), 8);
  job.part_offsets = ast_scratch(offsets * (int64_t)sizeof(int64_t) + (partials + dz + dA1) * (int64_t)sizeof(float) +
                                 round * (int64_t)sizeof(int32_t));
  if (!job.part_offsets) return AST_NO_MEMORY;
  job.partials = (float *)(job.part_offsets + offsets);
  job.dz = job.partials + partials;
  job.by_part = (int32_t *)(job.dz + dz + dA1);
  if (!step->M) memset(job.partials, 0, (size_t)partials * sizeof *job.partials);
  status = message_rounds(&job);
  return status == AST_OK ? message_add_partials(&job, job.dz + dz) : status;
}
