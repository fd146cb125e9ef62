/* Gradients of message passing (message.c), its layers recomputed tile by tile. With g_m = dsum_r(m) + dout_m,
 * u_m = (y_m - mean) / sd and <.> the mean over channels:
 *
 *   dgamma = sum_m g_m u_m,   dbeta = sum_m g_m,   p_m = gamma g_m,   dy_m = (p_m - <p_m> - u_m <p_m u_m>) / sd_m
 *   dW2 = sum_m dy_m x_m^T,   db2 = sum_m dy_m,   dz_m = (z_m > 0) W2^T dy_m,         x_m = relu(z_m)
 *   dA2 = sum_m dz_m h_m^T,   dc_m = (h_m > 0) A2^T dz_m,   dA1 = sum_m dc_m e_m^T,   da1 = sum_m dc_m,   de_m = A1^T dc_m
 *   dP_s = sum of dz_m over the edges from s,   dQ_r = sum of dz_m over the edges into r
 *
 * Edges come in rounds. First the tasks of a round, each a run of tiles, put dz into a buffer and add to weight gradients of
 * their own, of which there are at most SHARES. Then other tasks add the rows of the buffer to dQ, each for a run of receivers,
 * and to dP, each for the senders with the same index modulo PARTS. All go through their edges in stored order, so that each
 * sum runs in stored order whatever the rounds, tasks, threads and other scenes. At the end the weight gradients of the shares are added up
 * in order.
 *
 * Cost per edge: the forward flops again, and twice as many for the two products per layer (but E H once, unless de is wanted).
 * Memory: at most SHARES sums of weight gradients and SHARES * SHARE_TILES * MESSAGE_TILE rows of dz, 19 MB at 128 channels.
 */
#include "ast.h"
#include "gemm.h"
#include "simd.h"

enum {
  SHARES = 16,
  SHARE_TILES = 10, /* of a task of a round */
  PARTS = 8,
  ROWS_AHEAD = 8,     /* edges by which prefetching runs ahead */
  REDUCE_CHUNK = 4096 /* floats of the shares that a task adds up */
};

/* The gradients that are sums over all edges, as tiles add to them. */
typedef struct {
  float *W2, *A2, *A1; /* [F2, F], [F, H] and, transposed, [E, H], rows padded to whole vectors */
  float *b2, *gamma, *beta, *a1;
} message_sums;

typedef struct {
  message_weights w;
  const float *dsum, *dmessages;
  const ast_message_gradients *out;
  float *W2, *A2, *A1;              /* in panels, as the products with dy, dz and dc read them */
  float *dz;                        /* of the edges of this round, rows w.row apart */
  float *shares;                    /* [SHARES] */
  int64_t *part_offsets;            /* [tasks, PARTS + 1] places in by_part */
  int32_t *by_part;                 /* the edges of each task, less `begin`, by the part of their sender */
  int64_t share_size, tasks, edges; /* floats of a share; tasks of a round; edges of a task */
  int64_t begin, end;               /* the edges of this round */
} message_backward_job;

static int64_t message_sums_size(const ast_message *s) {
  const int64_t H = round_up(s->H, VW), F = round_up(s->F, VW), F2 = round_up(s->F2, VW);
  return round_up(s->F2 * F + s->F * H + s->E * H + 3 * F2 + H, 16);
}

static message_sums message_sums_at(const ast_message *s, float *memory) {
  const int64_t H = round_up(s->H, VW), F = round_up(s->F, VW), F2 = round_up(s->F2, VW);
  message_sums sums = {.W2 = memory};
  sums.A2 = sums.W2 + s->F2 * F;
  sums.A1 = sums.A2 + s->F * H;
  sums.b2 = sums.A1 + s->E * H;
  sums.gamma = sums.b2 + F2;
  sums.beta = sums.gamma + F2;
  sums.a1 = sums.beta + F2;
  return sums;
}

static void message_add(float *sums, const float *x, int64_t n) {
  for (int64_t c = 0; c < n; c++) sums[c] += x[c];
}

/* y becomes dy. Sums over the tile are added to those of the share at its end: shorter sums are more exact. */
static void message_norm_backward(const message_backward_job *job, int64_t first, int64_t n, float *tile, const message_sums *sums) {
  const message_weights *w = &job->w;
  const int64_t F2 = w->s->F2, columns = round_up(F2, VW);
  float *dgamma = tile + n * w->row, *dbeta = dgamma + columns, *db2 = dbeta + columns, *p_i = db2 + columns; /* behind the last row */
  memset(dgamma, 0, (size_t)(3 * columns) * sizeof *dgamma);
  for (int64_t i = 0; i < n; i++) {
    float *y = tile + i * w->row;
    const float *dsum = job->dsum + w->s->receivers[first + i] * F2;
    const float *dmessage = job->dmessages ? job->dmessages + (first + i) * F2 : NULL;
    const vf inverse = vsplat(message_center(w, y));
    vf mean = {0}, along = {0};
    for (int64_t c = 0; c < F2; c += VW) {
      vf g = message_load(dsum, c, F2);
      if (dmessage) g += message_load(dmessage, c, F2);
      const vf u = vload(y + c) * inverse, p = g * vload(w->gamma + c);
      vstore(y + c, u);
      vstore(p_i + c, p); /* not computed twice: fused into the difference below it would not cancel */
      mean += p;
      along += p * u;
      vstore(dbeta + c, vload(dbeta + c) + g);
      vstore(dgamma + c, vload(dgamma + c) + g * u);
    }
    mean = vsplat(vsum(mean) / (float)F2);
    along = vsplat(vsum(along) / (float)F2);
    for (int64_t c = 0; c < F2; c += VW) {
      const vf dy = (vload(p_i + c) - mean - vload(y + c) * along) * inverse;
      vstore(y + c, dy);
      vstore(db2 + c, vload(db2 + c) + dy);
    }
  }
  message_add(sums->gamma, dgamma, columns);
  message_add(sums->beta, dbeta, columns);
  message_add(sums->b2, db2, columns);
}

/* dx becomes dz, where relu let z through (or is NaN) */
static void message_relu_backward(const float *x, int64_t n, int64_t width, int64_t row, float *dx) {
  for (int64_t i = 0; i < n * row; i += row)
    for (int64_t c = 0; c < width; c += VW) vstore(dx + i + c, vselect(vload(x + i + c) <= 0, (vf){0}, vload(dx + i + c)));
}

static void message_column_sums(const float *x, int64_t n, int64_t width, int64_t row, float *sums) {
  for (int64_t c = 0; c < width; c += VW) {
    vf sum = {0};
    for (int64_t i = 0; i < n; i++) sum += vload(x + i * row + c);
    vstore(sums + c, vload(sums + c) + sum);
  }
}

static void message_tile_backward(const message_backward_job *job, int64_t first, int64_t n, int64_t ahead, const message_tile *t,
                                  const message_sums *sums) {
  const message_weights *w = &job->w;
  const ast_message *s = w->s;
  const int64_t H = round_up(s->H, VW), F = round_up(s->F, VW), E = s->E, row = w->row;
  const float *e = s->edge_features + first * E;
  float *dz = job->dz + (first - job->begin) * row, *dy = t->y, *dc = t->y;
  message_layers(w, first, n, ahead, t);
  message_norm_backward(job, first, n, t->y, sums);
  gemm(s->F2, F, n, (gemm_a){dy, 1, row}, gemm_rows(t->x, row), sums->W2, F, true);
  gemm(n, F, s->F2, (gemm_a){dy, row, 1}, gemm_packed(job->W2, s->F2), dz, row, false);
  message_relu_backward(t->x, n, F, row, dz);
  if (!H) return;
  gemm(s->F, H, n, (gemm_a){dz, 1, row}, gemm_rows(t->h, row), sums->A2, H, true);
  gemm(n, H, s->F, (gemm_a){dz, row, 1}, gemm_packed(job->A2, s->F), dc, row, false);
  message_relu_backward(t->h, n, H, row, dc);
  message_column_sums(dc, n, H, row, sums->a1);
  gemm(E, H, n, (gemm_a){e, 1, E}, gemm_rows(dc, row), sums->A1, H, true);
  if (!job->out->edge_features) return;
  float *de = t->x;
  gemm(n, round_up(E, VW), s->H, (gemm_a){dc, row, 1}, gemm_packed(job->A1, s->H), de, row, false);
  for (int64_t i = 0; i < n; i++) memcpy(job->out->edge_features + (first + i) * E, de + i * row, (size_t)E * sizeof *de);
}

/* Sorts the edges of a task by the part of their sender, in stored order within each. */
static void message_sort_by_part(const message_backward_job *job, int64_t begin, int64_t end, int64_t *part_offsets) {
  const int64_t *senders = job->w.s->senders;
  int64_t next[PARTS] = {0};
  for (int64_t m = begin; m < end; m++) next[senders[m] % PARTS]++;
  part_offsets[0] = begin - job->begin;
  for (int64_t p = 0; p < PARTS; p++) {
    part_offsets[p + 1] = part_offsets[p] + next[p];
    next[p] = part_offsets[p];
  }
  for (int64_t m = begin; m < end; m++) job->by_part[next[senders[m] % PARTS]++] = (int32_t)(m - job->begin);
}

static ast_status message_backward_task(int64_t index, void *context) {
  const message_backward_job *job = context;
  const int64_t begin = job->begin + index * job->edges, end = min64(job->end, begin + job->edges);
  float *memory = job->shares + index * job->share_size;
  message_tile t;
  if (!message_new_tile(&job->w, &t)) return AST_NO_MEMORY;
  if (!job->begin) memset(memory, 0, (size_t)job->share_size * sizeof *memory);
  const message_sums sums = message_sums_at(job->w.s, memory);
  message_sort_by_part(job, begin, end, job->part_offsets + index * (PARTS + 1));
  for (int64_t m = begin; m < end; m += MESSAGE_TILE) {
    const int64_t n = min64(MESSAGE_TILE, end - m), ahead = min64(MESSAGE_TILE, end - m - n);
    message_tile_backward(job, m, n, ahead, &t, &sums);
  }
  return AST_OK;
}

/* dP of the senders of a part; the first round clears them before. */
static void message_add_to_senders(const message_backward_job *job, int64_t part) {
  const ast_message *s = job->w.s;
  const int64_t F = s->F, *senders = s->senders + job->begin;
  for (int64_t r = part; !job->begin && r < s->S; r += PARTS) memset(job->out->of_senders + r * F, 0, (size_t)F * sizeof(float));
  for (int64_t task = 0; task * job->edges < job->end - job->begin; task++) {
    const int64_t *offsets = job->part_offsets + task * (PARTS + 1), last = offsets[part + 1];
    for (int64_t i = offsets[part]; i < last; i++) {
      const float *next = job->out->of_senders + senders[job->by_part[min64(i + ROWS_AHEAD, last - 1)]] * F;
      for (int64_t c = 0; c < F; c += 16) __builtin_prefetch(next + c, 1);
      const float *dz = job->dz + job->by_part[i] * job->w.row;
      float *dP = job->out->of_senders + senders[job->by_part[i]] * F;
      for (int64_t c = 0; c < F; c += VW) message_store(dP, c, F, message_load(dP, c, F) + vload(dz + c));
    }
  }
}

/* The first edge from m on that is not of the same receiver as the one before it. */
static int64_t message_next_receiver(const ast_message *s, int64_t m) { return m == 0 ? 0 : s->receiver_offsets[s->receivers[m - 1] + 1]; }

/* dQ of the receivers whose first edge in this round is in a part of it. A row is cleared before its first edge of all, together
 * with those between it and the row before. */
static void message_add_to_receivers(const message_backward_job *job, int64_t part) {
  const ast_message *s = job->w.s;
  const int64_t F = s->F, edges = job->end - job->begin;
  int64_t begin = job->begin + part * edges / PARTS, end = job->begin + (part + 1) * edges / PARTS;
  if (part) begin = message_next_receiver(s, begin);
  if (part + 1 < PARTS) end = message_next_receiver(s, end);
  for (int64_t m = begin; m < min64(end, job->end); m++) {
    const int64_t r = s->receivers[m];
    const float *dz = job->dz + (m - job->begin) * job->w.row;
    float *dQ = job->out->of_receivers + r * F;
    if (m == s->receiver_offsets[r]) {
      const int64_t before = m ? s->receivers[m - 1] + 1 : 0;
      memset(job->out->of_receivers + before * F, 0, (size_t)((r + 1 - before) * F) * sizeof *dQ);
    }
    for (int64_t c = 0; c < F; c += VW) message_store(dQ, c, F, message_load(dQ, c, F) + vload(dz + c));
  }
  if (end == s->M && part + 1 == PARTS) { /* receivers behind the last edge */
    const int64_t before = s->M ? s->receivers[s->M - 1] + 1 : 0;
    memset(job->out->of_receivers + before * F, 0, (size_t)((s->R - before) * F) * sizeof(float));
  }
}

static ast_status message_rows_task(int64_t index, void *context) {
  if (index < PARTS) message_add_to_senders(context, index);
  else message_add_to_receivers(context, index - PARTS);
  return AST_OK;
}

/* ---- the sum over the shares ---- */

/* The first share becomes the sum of all, in order. */
static ast_status message_reduce_task(int64_t index, void *context) {
  const message_backward_job *job = context;
  const int64_t begin = index * REDUCE_CHUNK, n = min64(REDUCE_CHUNK, job->share_size - begin);
  for (int64_t i = 1; i < job->tasks; i++) message_add(job->shares + begin, job->shares + i * job->share_size + begin, n);
  return AST_OK;
}

static void message_copy(const float *from, int64_t row, int64_t rows, int64_t columns, float *to) {
  for (int64_t i = 0; i < rows; i++) memcpy(to + i * columns, from + i * row, (size_t)columns * sizeof *to);
}

static void message_write_sums(const message_backward_job *job) {
  const ast_message *s = job->w.s;
  const ast_message_gradients *out = job->out;
  const message_sums sums = message_sums_at(s, job->shares);
  const int64_t H = round_up(s->H, VW), F = round_up(s->F, VW);
  message_copy(sums.W2, F, s->F2, s->F, out->W2);
  message_copy(sums.A2, H, s->F, s->H, out->A2);
  for (int64_t h = 0; h < s->H; h++)
    for (int64_t i = 0; i < s->E; i++) out->A1[h * s->E + i] = sums.A1[i * H + h];
  message_copy(sums.b2, 0, 1, s->F2, out->b2);
  message_copy(sums.gamma, 0, 1, s->F2, out->gamma);
  message_copy(sums.beta, 0, 1, s->F2, out->beta);
  message_copy(sums.a1, 0, 1, s->H, out->a1);
}

static ast_status message_backward_rounds(message_backward_job *job) {
  const ast_message *s = job->w.s;
  ast_status status = AST_OK;
  do { /* once even without edges, to clear dP and dQ */
    job->end = min64(s->M, job->begin + job->tasks * job->edges);
    const int64_t tasks = (job->end - job->begin + job->edges - 1) / job->edges;
    status = ast_parallel(tasks, message_backward_task, job);
    if (status == AST_OK) status = ast_parallel(2 * PARTS, message_rows_task, job);
    job->begin = job->end;
  } while (status == AST_OK && job->begin < s->M);
  return status;
}

static ast_status message_backward(const ast_message *s, const float *restrict dsum, const float *restrict dmessages,
                                   const ast_message_gradients *out) {
  const int64_t tiles = (s->M + MESSAGE_TILE - 1) / MESSAGE_TILE, most = min64(SHARES, max64(1, tiles));
  const int64_t a_task = min64(SHARE_TILES, max64(1, (tiles + most - 1) / most));
  message_backward_job job = {.dsum = dsum, .dmessages = dmessages, .out = out, .edges = a_task * MESSAGE_TILE};
  job.tasks = min64(most, max64(1, (tiles + a_task - 1) / a_task));
  job.share_size = message_sums_size(s);

  const int64_t forward = round_up(message_packed_size(s), 16), W2 = gemm_packed_size(s->F2, s->F), A2 = gemm_packed_size(s->F, s->H);
  float *packed = ast_scratch(6, (forward + W2 + A2 + gemm_packed_size(s->H, s->E)) * (int64_t)sizeof *packed);
  if (!packed) return AST_NO_MEMORY;
  job.w = message_pack(s, packed);
  job.W2 = packed + forward;
  job.A2 = job.W2 + W2;
  job.A1 = job.A2 + A2;
  gemm_pack(s->W2, s->F, 1, s->F2, s->F, job.W2);
  gemm_pack(s->A2, s->H, 1, s->F, s->H, job.A2);
  gemm_pack(s->A1, s->E, 1, s->H, s->E, job.A1);

  const int64_t round = job.tasks * job.edges, floats = job.tasks * job.share_size + round * job.w.row;
  const int64_t offsets = job.tasks * (PARTS + 1) * (int64_t)sizeof *job.part_offsets;
  job.shares = ast_scratch(7, floats * (int64_t)sizeof *job.shares + offsets + round * (int64_t)sizeof *job.by_part);
  if (!job.shares) return AST_NO_MEMORY;
  job.dz = job.shares + job.tasks * job.share_size;
  job.part_offsets = (int64_t *)(job.shares + floats);
  job.by_part = (int32_t *)(job.part_offsets + job.tasks * (PARTS + 1));
  if (!s->M) memset(job.shares, 0, (size_t)job.share_size * sizeof *job.shares);
  ast_status status = message_backward_rounds(&job);
  if (status == AST_OK) status = ast_parallel((job.share_size + REDUCE_CHUNK - 1) / REDUCE_CHUNK, message_reduce_task, &job);
  if (status == AST_OK) message_write_sums(&job);
  return status;
}
