/* Gradients of message passing (message.c), its layers recomputed tile by tile. With g_m = dsum_r(m) + dout_m,
 * u_m = (y_m - mean) / sd and <.> the mean over channels:
 *
 *   dgamma = sum_m g_m u_m,   dbeta = sum_m g_m,   p_m = gamma g_m,   dy_m = (p_m - <p_m> - u_m <p_m u_m>) / sd_m
 *   dW2 = sum_m dy_m x_m^T,   db2 = sum_m dy_m,    dz_m = (x_m > 0) W2^T dy_m
 *   dA2 = sum_m dz_m h_m^T,   dc_m = (h_m > 0) A2^T dz_m
 *   dA1 = sum_m dc_m e_m^T,   da1 = sum_m dc_m,    de_m = A1^T dc_m, or de_m = dz_m where e_m is added as it is
 *   dP_s = sum of dz_m over the edges from s,      dQ_r = sum of dz_m over the edges into r
 *
 * Edges come in rounds. First the tasks of a round, each a run of tiles, put dz into a buffer and add to weight
 * gradients of their own, of which there are at most ROUND_TASKS. Then other tasks add the rows of the buffer to dQ,
 * each for a run of receivers, and to dP, each for the senders with the same index modulo PARTS. All go through their
 * edges in stored order, and count the edges of a node with many, so that each sum runs in stored order and by the same
 * chains whatever the rounds, tasks, threads and other scenes. At the end the weight gradients of the tasks are added
 * up in order.
 *
 * Cost per edge: the forward flops again, and twice as many for the two products per layer (but E H once, unless de is
 * wanted). Memory: at most 2 ROUND_TASKS sums of weight gradients and ROUND_TASKS * TASK_TILES * MESSAGE_TILE rows of
 * dz, 13 MB at 128 channels.
 */
#include "weight_panels.h"

enum {
  ROUND_TASKS = 16,
  TASK_TILES = 10, /* of a task of a round */
  PARTS = 8,
  ROWS_AHEAD = 6 /* edges by which prefetching runs ahead */
};

/* The gradients that are sums over all edges; dA1 is transposed, [E,H]. */
enum { MESSAGE_DW2, MESSAGE_DA2, MESSAGE_DA1, MESSAGE_DB2, MESSAGE_DGAMMA, MESSAGE_DBETA, MESSAGE_Da1, MESSAGE_SUMS };

/* The sums over the edges of each of some nodes. One of more than MESSAGE_CHAIN edges has chains of its own. */
typedef struct {
  float *sums;         /* [nodes, F] */
  int64_t *chains_of;  /* [nodes]: the number of such a node, or -1 */
  int64_t *all, *done; /* of each such node: its edges, and how many of them are added */
  float *chains;       /* [such nodes, 2, F] */
} message_node_sums;

typedef struct {
  message_weights w;
  const float *dsum, *dmessages;
  const ast_message_gradients *out;
  message_node_sums dP, dQ;
  float *dz;               /* of the edges of this round, rows w.row apart */
  dense_partials partials; /* of each task of a round */
  int64_t *part_offsets;   /* [tasks, PARTS + 1] places in by_part */
  int32_t *by_part;        /* the edges of each task, less `begin`, by the part of their sender */
  int64_t tasks, edges;    /* tasks of a round; edges of a task */
  int64_t begin, end;      /* the edges of this round */
} message_backward_job;

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

/* y becomes dy. Sums over the tile are added to the sums of the task at its end: shorter sums are more exact. */
AST_INLINE void message_norm_backward(const message_backward_job *job, int64_t first, int64_t n, const message_tile *t,
                                      float *partials, const bool whole) {
  const ast_message *step = job->w.step;
  const dense_sum *sums = job->partials.sums;
  const int64_t F2 = step->F2, row = job->w.row;
  norm_clear_columns(&t->columns);
  for (int64_t i = 0; i < n; i++) {
    float *y = t->y + i * row;
    const float *dmessage = job->dmessages ? job->dmessages + (first + i) * F2 : NULL;
    const float scale = norm_centre(y, F2, whole);
    norm_backward(i, F2, whole, step->gamma, job->dsum + step->receivers[first + i] * F2, dmessage, scale, NULL, y,
                  &t->columns);
  }
  dense_add_rows(t->columns.dgamma, row, NORM_CHAINS, F2, partials + sums[MESSAGE_DGAMMA].at);
  dense_add_rows(t->columns.dbeta, row, NORM_CHAINS, F2, partials + sums[MESSAGE_DBETA].at);
  dense_add_rows(t->y, row, n, F2, partials + sums[MESSAGE_DB2].at);
}

/* dz of the tile into the buffer, and the weight gradients added to the partial sums, or put into the matrices among
 * them unless `add`. */
static void message_tile_backward(const message_backward_job *job, int64_t first, int64_t n, bool add,
                                  const message_tile *t, float *partials) {
  const message_weights *w = &job->w;
  const ast_message *step = w->step;
  const dense_sum *sums = job->partials.sums;
  const int64_t H = sums[MESSAGE_DA2].row, F = sums[MESSAGE_DW2].row, E = step->E, row = w->row;
  float *dz = job->dz + (first - job->begin) * row, *dy = t->y, *dc = t->y;
  message_layers(w, first, n, t);
  if (step->F2 % VW) message_norm_backward(job, first, n, t, partials, false);
  else message_norm_backward(job, first, n, t, partials, true);
  /* forward: y = W2 x + b2, so dW2 = dy x^T and dx = W2^T dy */
  gemm(step->F2, F, n, dy, row, t->x, row, partials + sums[MESSAGE_DW2].at, F, add);
  dense_all(&w->layers[MESSAGE_W2_BACK], n, (gemm_a){dy, row, 1},
            (dense_end){.out = dz, .out_row = row, .hidden = t->x, .hidden_row = row});
  /* forward: x = relu(P + Q + e), so de = dz */
  float *de = job->out->edge_features;
  for (int64_t i = 0; de && message_has_latents(step) && i < n; i++)
    memcpy(de + (first + i) * E, dz + i * row, (size_t)E * sizeof *de);
  if (!H) return;
  /* forward: x = relu(P + Q + A2 h), so dA2 = dz h^T and dh = A2^T dz */
  gemm(step->F, H, n, dz, row, t->h, row, partials + sums[MESSAGE_DA2].at, H, add);
  dense_all(&w->layers[MESSAGE_A2_BACK], n, (gemm_a){dz, row, 1},
            (dense_end){.out = dc, .out_row = row, .hidden = t->h, .hidden_row = row});
  /* forward: h = relu(A1 e + a1), so da1 = dc, dA1 = dc e^T and de = A1^T dc */
  dense_add_rows(dc, row, n, step->H, partials + sums[MESSAGE_Da1].at);
  gemm(E, H, n, step->edge_features + first * E, E, dc, row, partials + sums[MESSAGE_DA1].at, H, add);
  if (de)
    dense_all(&w->layers[MESSAGE_A1_BACK], n, (gemm_a){dc, row, 1}, (dense_end){.out = de + first * E, .out_row = E});
}

static ast_status message_backward_task(int64_t index, void *context) {
  const message_backward_job *job = context;
  const int64_t begin = job->begin + index * job->edges, end = min64(job->end, begin + job->edges);
  float *partials =
      job->begin ? job->partials.memory + index * job->partials.apart : dense_start_chunk(&job->partials, index, false);
  message_tile t;
  if (!message_new_tile(&job->w, &t)) return AST_NO_MEMORY;
  message_sort_by_part(job, begin, end, job->part_offsets + index * (PARTS + 1));
  int64_t block = job->begin / job->tasks / MESSAGE_TILE; /* tiles of this task in the rounds before */
  for (int64_t m = begin; m < end; m += MESSAGE_TILE, block++) {
    const bool add = dense_begin_block(&job->partials, block, partials);
    message_tile_backward(job, m, min64(MESSAGE_TILE, end - m), add, &t, partials);
  }
  return AST_OK;
}

/* Sums of nodes, of which sums->chains_of counts the edges so far. */
static bool message_new_sums(const ast_message *step, int64_t nodes, message_node_sums *sums) {
  int64_t num = 0;
  for (int64_t i = 0; i < nodes; i++) num += sums->chains_of[i] > MESSAGE_CHAIN;
  sums->all = ast_scratch(2 * num * (int64_t)sizeof *sums->all);
  sums->chains = ast_scratch(2 * num * step->F * (int64_t)sizeof *sums->chains);
  if (!sums->all || !sums->chains) return false;
  sums->done = sums->all + num;
  memset(sums->done, 0, (size_t)num * sizeof *sums->done);
  memset(sums->chains, 0, (size_t)(2 * num * step->F) * sizeof *sums->chains);
  num = 0;
  for (int64_t i = 0; i < nodes; i++) {
    const int64_t edges = sums->chains_of[i];
    sums->chains_of[i] = edges > MESSAGE_CHAIN ? num : -1;
    if (edges > MESSAGE_CHAIN) sums->all[num++] = edges;
  }
  return true;
}

static bool message_new_all_sums(message_backward_job *job) {
  const ast_message *step = job->w.step;
  int64_t *of_senders = ast_scratch((step->S + step->R) * (int64_t)sizeof *of_senders);
  if (!of_senders) return false;
  memset(of_senders, 0, (size_t)step->S * sizeof *of_senders);
  for (int64_t m = 0; m < step->M; m++) of_senders[step->senders[m]]++;
  int64_t *of_receivers = of_senders + step->S;
  for (int64_t r = 0; r < step->R; r++) of_receivers[r] = step->receiver_offsets[r + 1] - step->receiver_offsets[r];
  job->dP = (message_node_sums){.sums = job->out->of_senders, .chains_of = of_senders};
  job->dQ = (message_node_sums){.sums = job->out->of_receivers, .chains_of = of_receivers};
  return message_new_sums(step, step->S, &job->dP) && message_new_sums(step, step->R, &job->dQ);
}

/* forward: z += P[sender] + Q[receiver] */
AST_INLINE void message_add_row(const message_node_sums *sums, int64_t node, int64_t F, const float *dz) {
  const int64_t number = sums->chains_of[node];
  float *sum = sums->sums + node * F, *to = number < 0 ? sum : sums->chains + 2 * number * F;
  for (int64_t c = 0; c < F; c += VW) vstore_upto(to + c, vload_upto(to + c, F - c) + vload(dz + c), F - c);
  if (number >= 0) message_end_chains(++sums->done[number], sums->all[number], F, to, sum);
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
      message_add_row(&job->dP, senders[m], F, job->dz + m * job->w.row);
    }
  }
}

/* dQ of the receivers whose first edge is in a part of this round; in the last part, of all receivers behind it, too;
 * in the first part, of the receiver whose edges the round before has begun, too. */
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
      message_add_row(&job->dQ, r, F, job->dz + (m - job->begin) * job->w.row);
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

static ast_status message_backward(const ast_message *step, const float *restrict dsum, const float *restrict dmessages,
                                   const ast_message_gradients *out) {
  AST_SCRATCH_SCOPE;
  message_backward_job job = {.dsum = dsum, .dmessages = dmessages, .out = out};
  ast_status status = message_pack(step, true, &job.w);
  if (status != AST_OK) return status;
  const int64_t tiles = max64(1, divide_up(step->M, MESSAGE_TILE)), most = ROUND_TASKS * TASK_TILES,
                rounds = divide_up(tiles, most);
  const int64_t of_round = divide_up(tiles, rounds), of_task = divide_up(of_round, ROUND_TASKS);
  job.edges = MESSAGE_TILE * of_task;
  job.tasks = divide_up(of_round, of_task);

  const int64_t round = job.tasks * job.edges;
  job.part_offsets = ast_scratch(job.tasks * (PARTS + 1) * (int64_t)sizeof *job.part_offsets);
  job.by_part = ast_scratch(round * (int64_t)sizeof *job.by_part);
  job.dz = ast_scratch(round * job.w.row * (int64_t)sizeof *job.dz);
  float *dA1 = ast_scratch(step->E * step->H * (int64_t)sizeof *dA1);
  dense_sum sums[] = {[MESSAGE_DW2] = {.to = out->W2, .rows = step->F2, .n = step->F},
                      [MESSAGE_DA2] = {.to = out->A2, .rows = step->F, .n = step->H},
                      [MESSAGE_DA1] = {.to = dA1, .rows = step->E, .n = step->H},
                      [MESSAGE_DB2] = {.to = out->b2, .rows = 1, .n = step->F2},
                      [MESSAGE_DGAMMA] = {.to = out->gamma, .rows = 1, .n = step->F2},
                      [MESSAGE_DBETA] = {.to = out->beta, .rows = 1, .n = step->F2},
                      [MESSAGE_Da1] = {.to = out->a1, .rows = 1, .n = step->H}};
  job.partials = dense_place_sums(sums, MESSAGE_SUMS);
  if (!job.part_offsets || !job.by_part || !job.dz || !dA1 ||
      !dense_new_partials(&job.partials, job.tasks, rounds * of_task) || !message_new_all_sums(&job))
    return AST_NO_MEMORY;
  if (!step->M) dense_start_chunk(&job.partials, 0, true);
  status = message_rounds(&job);
  if (status == AST_OK) status = dense_add_partials(&job.partials);
  if (status != AST_OK) return status;
  for (int64_t h = 0; h < step->H; h++)
    for (int64_t i = 0; i < step->E; i++) out->A1[h * step->E + i] = dA1[i * step->H + h];
  return AST_OK;
}
