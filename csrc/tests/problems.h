/* Problems that more than one C test poses, in buffers of just their size. */
#ifndef AST_PROBLEMS_H
#define AST_PROBLEMS_H

#include "check.h"

/* ---- the pairs of a sparse convolution ---- */

enum { OFFSETS = 27 };

/* Pairs in buffers of just their size. */
static ast_pairs copy_pairs(const int64_t *offsets, const int64_t *source, const int64_t *destination) {
  const int64_t n = offsets[OFFSETS];
  return (ast_pairs){copy_ints(offsets, OFFSETS + 1), copy_ints(source, n), copy_ints(destination, n)};
}
#define PAIR_BUFFERS(p) (p)->offsets, (p)->source, (p)->destination

/* A destination has a pair in a group with the given probability; its source is any row of the same part of the rows,
 * of which there are `parts` (the scenes of a batch). */
static ast_pairs random_pairs(int64_t sources, int64_t destinations, double density, int64_t parts) {
  int64_t *source = malloc((size_t)(OFFSETS * destinations + 1) * sizeof *source), offsets[OFFSETS + 1] = {0}, n = 0;
  int64_t *destination = malloc((size_t)(OFFSETS * destinations + 1) * sizeof *destination);
  CHECK(source && destination, "no memory");
  for (int k = 0; k < OFFSETS; k++) {
    for (int64_t d = 0; d < destinations; d++) {
      if (sources < parts || random_unit() >= density || k == 5) continue; /* group 5 is empty */
      const int64_t part = d * parts / destinations, first = part * sources / parts,
                    last = (part + 1) * sources / parts;
      source[n] = first + (int64_t)(random_bits() % (uint64_t)(last - first));
      destination[n++] = d;
    }
    offsets[k + 1] = n;
  }
  const ast_pairs pairs = copy_pairs(offsets, source, destination);
  free(source), free(destination);
  return pairs;
}

/* ---- message passing ---- */

/* M edges whose ends lie in the same of `parts` parts of S senders and R receivers (the scenes of a batch), and random
 * weights. */
static ast_message new_message(int64_t M, int64_t S, int64_t R, int64_t E, int64_t H, int64_t F, int64_t F2,
                               int64_t parts) {
  int64_t *senders = new_ints(M), *receivers = new_ints(M), *offsets = new_ints(R + 1);
  memset(offsets, 0, (size_t)(R + 1) * sizeof *offsets);
  for (int64_t m = 0; m < M; m++) offsets[m * R / M + 1]++; /* about the same number each, */
  for (int64_t r = 1; R > 5 && r < R; r += 5) {             /* but every fifth gives its edges to the one before */
    offsets[r] += offsets[r + 1];
    offsets[r + 1] = 0;
  }
  for (int64_t r = 0; r < R; r++) offsets[r + 1] += offsets[r];
  for (int64_t r = 0; r < R; r++)
    for (int64_t m = offsets[r]; m < offsets[r + 1]; m++) {
      const int64_t part = r * parts / R, first = part * S / parts, last = (part + 1) * S / parts;
      receivers[m] = r;
      senders[m] = first + (int64_t)(random_bits() % (uint64_t)(last - first));
    }
  return (ast_message){
      .M = M,
      .S = S,
      .R = R,
      .E = E,
      .H = H,
      .F = F,
      .F2 = F2,
      .senders = senders,
      .receivers = receivers,
      .receiver_offsets = offsets,
      .of_senders = random_floats(S * F),
      .of_receivers = random_floats(R * F),
      .edge_features = random_floats(M * E),
      .A1 = random_floats(H * E),
      .a1 = random_floats(H),
      .A2 = scaled_floats(F * H, 0.3f),
      .W2 = scaled_floats(F2 * F, 0.3f),
      .b2 = random_floats(F2),
      .gamma = random_floats(F2),
      .beta = random_floats(F2),
  };
}

#define MESSAGE_BUFFERS(s)                                                                                     \
  (s)->senders, (s)->receivers, (s)->receiver_offsets, (s)->of_senders, (s)->of_receivers, (s)->edge_features, \
      (s)->A1, (s)->a1, (s)->A2, (s)->W2, (s)->b2, (s)->gamma, (s)->beta

/* What message gives, and the ten gradients of message_backward. */
enum { MESSAGE_RESULTS = 12, SUM = 0, MESSAGES, P, Q, EDGES, A1, B1, A2, W2, B2, GAMMA, BETA };

typedef struct {
  int64_t size[MESSAGE_RESULTS];
  float *of[MESSAGE_RESULTS];
} message_results;

static message_results new_message_results(const ast_message *s) {
  message_results r = {.size = {s->R * s->F2, s->M * s->F2, s->S * s->F, s->R * s->F, s->M * s->E, s->H * s->E, s->H,
                                s->F * s->H, s->F2 * s->F, s->F2, s->F2, s->F2}};
  for (int i = 0; i < MESSAGE_RESULTS; i++) r.of[i] = new_floats(r.size[i]);
  return r;
}
static ast_message_gradients gradients_of(const message_results *r) {
  float *const *of = r->of;
  return (ast_message_gradients){of[P], of[Q], of[EDGES], of[A1], of[B1], of[A2], of[W2], of[B2], of[GAMMA], of[BETA]};
}
static void free_message_results(message_results r) {
  for (int i = 0; i < MESSAGE_RESULTS; i++) FREE(r.of[i]);
}

/* Both directions. */
static message_results solve_message(const ast_kernels *kernels, const ast_message *s, const float *dsum,
                                     const float *dmessages) {
  const message_results r = new_message_results(s);
  const ast_message_gradients gradients = gradients_of(&r);
  READ_ONLY(MESSAGE_BUFFERS(s), dsum, dmessages);
  CHECK(kernels->message(s, r.of[SUM], r.of[MESSAGES]) == AST_OK, "status");
  CHECK(kernels->message_backward(s, dsum, dmessages, &gradients) == AST_OK, "status");
  WRITABLE(MESSAGE_BUFFERS(s), dsum, dmessages);
  return r;
}

/* ---- elastic forces ---- */

/* E elements in cubes of a grid of about E / 5 nodes, whose nodes are moved by up to a fifth of a cube: none is flat.
 * Some nodes have no element. */
static ast_elastic new_elastic(int64_t E, float scale) {
  static const int steps[6][2] = {{1, 2}, {1, 4}, {2, 1},
                                  {2, 4}, {4, 1}, {4, 2}}; /* from a corner of a cube to the opposite one */
  int64_t side = 2;
  while (side * side * side * 5 < E) side++;
  const int64_t N = side * side * side;
  int64_t *elements = new_ints(4 * E), *order = new_ints(4 * E), *offsets = new_ints(N + 1);
  float *rest = new_floats(3 * N), *position = random_floats(3 * N), *lame = new_floats(2 * E);
  for (int64_t i = 0; i < 3 * N; i++) {
    const int64_t at = i / 3 / (i % 3 == 0 ? 1 : i % 3 == 1 ? side : side * side) % side;
    rest[i] = scale * ((float)at + 0.2f * random_float());
    position[i] = rest[i] + 0.2f * scale * position[i];
  }
  for (int64_t e = 0; e < E; e++) {
    const int *step = steps[random_bits() % 6];
    int64_t cube = 0;
    for (int64_t a = 0, width = 1; a < 3; a++, width *= side)
      cube += (int64_t)(random_bits() % (uint64_t)(side - 1)) * width;
    for (int corner = 0; corner < 4; corner++) {
      const int bits = corner == 3 ? 7 : corner == 2 ? step[0] + step[1] : corner == 1 ? step[0] : 0;
      elements[4 * e + corner] = cube + (bits & 1) + (bits >> 1 & 1) * side + (bits >> 2) * side * side;
    }
    lame[2 * e] = 1 + random_float(), lame[2 * e + 1] = 1.5f + random_float();
  }
  memset(offsets, 0, (size_t)(N + 1) * sizeof *offsets);
  for (int64_t k = 0; k < 4 * E; k++) offsets[elements[k] + 1]++;
  for (int64_t n = 0; n < N; n++) offsets[n + 1] += offsets[n];
  for (int64_t k = 0; k < 4 * E; k++) order[offsets[elements[k]]++] = k; /* each offset moves to the end of its node, */
  for (int64_t n = N; n > 0; n--) offsets[n] = offsets[n - 1];           /* which is where the next one begins */
  offsets[0] = 0;
  return (ast_elastic){N, E, elements, order, offsets, position, rest, lame};
}

#define ELASTIC_BUFFERS(s) \
  (s)->elements, (s)->node_order, (s)->node_offsets, (s)->position, (s)->rest_position, (s)->lame

/* ---- surfaces of bodies ---- */

/* B scenes of `bodies` balls each, of R rings of R + 2 nodes and two poles, with dents: they touch and overlap. The
 * last node of each scene belongs to no triangle, and the first scene is empty. */
static ast_proximity new_balls(int64_t B, int64_t bodies, int64_t R, float scale, double radius) {
  const int64_t S = R + 2, per_ball = R * S + 2, faces = 2 * R * S, scenes = B ? B - 1 : 0;
  const int64_t N = scenes * (bodies * per_ball + 1), F = scenes * bodies * faces;
  int64_t *offsets = new_ints(B + 1), *surface_offsets = new_ints(B + 1), *body = new_ints(N),
          *surface = new_ints(3 * F);
  float *position = new_floats(3 * N), *motion = random_floats(3 * N);
  int64_t n = 0, f = 0;
  offsets[0] = surface_offsets[0] = 0;
  for (int64_t b = 0; b < B; b++) {
    for (int64_t k = 0; b && k < bodies; k++) {
      const double center[3] = {random_unit(), random_unit(), random_unit()};
      const int64_t first = n, south = n + per_ball - 2, north = south + 1;
      for (int64_t i = 0; i < per_ball; i++, n++) {
        const double height = i < R * S ? M_PI * (double)(i / S + 1) / (double)(R + 1) : i == per_ball - 1 ? 0 : M_PI;
        const double turn = 2 * M_PI * (double)(i % S) / (double)S, size = 0.4 + 0.1 * random_unit();
        const double way[3] = {sin(height) * cos(turn), sin(height) * sin(turn), cos(height)};
        for (int a = 0; a < 3; a++) position[3 * n + a] = scale * (float)(center[a] + size * way[a]);
        body[n] = 5 - 2 * k;
      }
      for (int64_t i = 0; i < faces; i++, f++) { /* two around each node of a ring: to the ring after, or the poles */
        const int64_t ring = i / 2 / S, at = i / 2 % S, next = (at + 1) % S, here = first + ring * S, after = here + S;
        const bool last = ring == R - 1;
        const int64_t down[3] = {here + at, last ? south : after + at, here + next};
        const int64_t up[3] = {here + next, last ? first + next : after + at, last ? first + at : after + next};
        for (int a = 0; a < 3; a++) surface[3 * f + a] = i % 2 == 0 ? down[a] : last && a == 0 ? north : up[a];
        if (i % 2 && last) surface[3 * f + 1] = first + at, surface[3 * f + 2] = first + next;
      }
    }
    if (b) {
      body[n] = 100;
      for (int a = 0; a < 3; a++) position[3 * n + a] = scale * random_float();
      n++;
    }
    offsets[b + 1] = n, surface_offsets[b + 1] = f;
  }
  for (int64_t i = 0; i < 3 * N; i++) motion[i] *= 0.01f * scale;
  return (ast_proximity){B, N, F, position, motion, offsets, surface_offsets, body, surface, radius * (double)scale};
}

#define PROXIMITY_BUFFERS(s) (s)->position, (s)->motion, (s)->offsets, (s)->surface_offsets, (s)->body, (s)->surface

/* ---- attention blocks ---- */

/* Q vectors that attend to K others in scenes of the given offsets, which it takes. `floats` makes the numbers. */
static ast_attention_block new_block(int64_t *q_offsets, int64_t *k_offsets, int64_t B, int64_t W, int64_t C, int64_t H,
                                     int64_t D, int64_t F, bool rotated, float *(*floats)(int64_t)) {
  const int64_t I = H * D, queries = q_offsets[B], keys = k_offsets[B];
  ast_attention_block s = {.B = B, .Q = queries, .K = keys, .W = W, .C = C, .H = H, .D = D, .F = F};
  s.q_offsets = q_offsets, s.k_offsets = k_offsets;
  s.x = floats(queries * W), s.context = floats(keys * C);
  if (rotated) s.rotations = floats(queries * D), s.context_rotations = floats(keys * D);
  s.gamma = floats(W), s.beta = floats(W), s.context_gamma = floats(C), s.context_beta = floats(C);
  s.query = floats(I * W), s.key_value = floats(2 * I * C), s.weight = floats(W * I), s.bias = floats(W);
  s.inner_gamma = floats(W), s.inner_beta = floats(W);
  s.first = floats(2 * F * W), s.first_bias = floats(2 * F), s.second = floats(W * F), s.second_bias = floats(W);
  return s;
}
#define BLOCK_BUFFERS(s)                                                                                       \
  (s).x, (s).context, (s).rotations, (s).context_rotations, (s).q_offsets, (s).k_offsets, (s).gamma, (s).beta, \
      (s).context_gamma, (s).context_beta, (s).query, (s).key_value, (s).weight, (s).bias, (s).inner_gamma,    \
      (s).inner_beta, (s).first, (s).first_bias, (s).second, (s).second_bias

enum { BLOCK_RESULTS = 17, BLOCK_KEPT = 8 };
static const char *const block_names[BLOCK_RESULTS] = {
    "out",           "dx",     "dcontext",    "dgamma",  "dbeta",       "dcontext_gamma",
    "dcontext_beta", "dquery", "dkey_value",  "dweight", "dbias",       "dinner_gamma",
    "dinner_beta",   "dfirst", "dfirst_bias", "dsecond", "dsecond_bias"};

/* out, and the gradients in the order of the struct; and what is kept between. */
typedef struct {
  int64_t size[BLOCK_RESULTS];
  float *of[BLOCK_RESULTS];
  ast_attention_block_kept kept;
  ast_attention_block_gradients gradients;
} block_results;
_Static_assert(sizeof(ast_attention_block_gradients) == (BLOCK_RESULTS - 1) * sizeof(float *), "one each");

static block_results new_block_results(const ast_attention_block *s, bool keep_z) {
  const int64_t queries = s->Q, K = s->K, W = s->W, C = s->C, F = s->F, I = s->H * s->D;
  block_results r = {.size = {queries * W, queries * W, K * C, W, W, C, C, I * W, 2 * I * C, W * I, W, W, W, 2 * F * W,
                              2 * F, W * F, W}};
  for (int i = 0; i < BLOCK_RESULTS; i++) r.of[i] = new_floats(r.size[i]);
  memcpy(&r.gradients, r.of + 1, sizeof r.gradients);
  r.kept = (ast_attention_block_kept){new_floats(queries * I),
                                      new_floats(K * 2 * I),
                                      new_floats(queries * I),
                                      new_floats(queries * s->H),
                                      new_floats(queries * s->H),
                                      new_floats(queries * W),
                                      keep_z ? new_floats(queries * 2 * F) : NULL,
                                      new_floats(queries * F)};
  return r;
}
#define KEPT_BUFFERS(k) (k).queries, (k).keys_values, (k).mixed, (k).maximum, (k).total, (k).y, (k).z, (k).hidden

/* Both directions. */
static block_results solve_block(const ast_kernels *kernels, const ast_attention_block *s, const float *dout,
                                 bool keep_z) {
  const block_results r = new_block_results(s, keep_z);
  READ_ONLY(BLOCK_BUFFERS(*s), dout);
  CHECK(kernels->attention_block(s, r.of[0], r.kept) == AST_OK, "status");
  READ_ONLY(KEPT_BUFFERS(r.kept));
  CHECK(kernels->attention_block_backward(s, dout, r.kept, r.gradients) == AST_OK, "status");
  WRITABLE(BLOCK_BUFFERS(*s), dout);
  WRITABLE(KEPT_BUFFERS(r.kept));
  return r;
}
static void free_block_results(block_results r) {
  for (int i = 0; i < BLOCK_RESULTS; i++) FREE(r.of[i]);
  FREE(KEPT_BUFFERS(r.kept));
}

#endif
