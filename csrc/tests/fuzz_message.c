/* Fuzzes message and its gradients: the gradients that are not sums over edges, and the messages, have the same bits
 * for a scene alone and in a batch; where all values are moderate, sum and messages agree with the formula in double
 * within a loose bound. */
#define main tests_of_message
#include "test_message.c"
#undef main

#include "fuzz.h"

/* The receivers from `first` on with their edges; all senders stay. */
static void check_part(const ast_kernels *kernels, const ast_message *s, const float *dsum, const float *dmessages,
                       const message_results *all, int64_t first) {
  ast_message part = *s;
  const int64_t *offsets = s->receiver_offsets, edge = offsets[first];
  int64_t *receivers = new_ints(s->M - edge), *part_offsets = new_ints(s->R - first + 1);
  part.M = s->M - edge, part.R = s->R - first;
  for (int64_t m = 0; m < part.M; m++) receivers[m] = s->receivers[edge + m] - first;
  for (int64_t r = 0; r <= part.R; r++) part_offsets[r] = offsets[first + r] - edge;
  part.senders += edge, part.edge_features += edge * s->E, part.of_receivers += first * s->F;
  part.receivers = receivers, part.receiver_offsets = part_offsets;
  const message_results r =
      solve_message(kernels, &part, dsum + first * s->F2, dmessages ? dmessages + edge * s->F2 : NULL);
  CHECK(same_floats(r.of[SUM], all->of[SUM] + first * s->F2, part.R * s->F2), "sum of receivers from %lld on",
        (long long)first);
  CHECK(same_floats(r.of[MESSAGES], all->of[MESSAGES] + edge * s->F2, part.M * s->F2), "messages from %lld on",
        (long long)edge);
  CHECK(same_floats(r.of[Q], all->of[Q] + first * s->F, part.R * s->F), "dof_receivers from %lld on", (long long)first);
  CHECK(same_floats(r.of[EDGES], all->of[EDGES] + edge * s->E, part.M * s->E), "dedge_features from %lld on",
        (long long)edge);
  free_message_results(r);
  FREE(receivers, part_offsets);
}

/* A LayerNorm magnifies errors by at most 1 / sqrt(eps) < 320. */
static void check_values(const ast_message *s, const float *dsum, const float *dmessages, const message_results *r) {
  const int64_t sizes[] = {s->S * s->F, s->R * s->F,  s->M * s->E, s->H * s->E, s->H,
                           s->F * s->H, s->F2 * s->F, s->F2,       s->F2,       s->F2};
  const float *const inputs[] = {s->of_senders, s->of_receivers, s->edge_features, s->A1,  s->a1, s->A2,
                                 s->W2,         s->b2,           s->gamma,         s->beta};
  double most[10];
  bool finite = all_finite(dsum, s->R * s->F2) && (!dmessages || all_finite(dmessages, s->M * s->F2));
  for (int i = 0; i < 10; i++) {
    finite &= all_finite(inputs[i], sizes[i]);
    most[i] = largest_finite(inputs[i], sizes[i]);
  }
  const double h = (double)s->E * most[2] * most[3] + most[4], of_edges = s->H ? (double)s->H * h * most[5] : most[2];
  const double z = most[0] + most[1] + of_edges;
  const double y = (double)s->F * z * most[6] + most[7], scale = most[8] + most[9] + 1;
  if (!finite || !(y < 1e4 && z < 1e4 && h < 1e4 && scale < 1e4)) return;
  const double error = 4e-7 * (double)(s->E + s->H + s->F + s->F2 + 8) * fmax(1, y) * 320 * scale;
  double *exact[MESSAGE_RESULTS];
  for (int i = 0; i < MESSAGE_RESULTS; i++) {
    exact[i] = calloc((size_t)(r->size[i] + 1), sizeof *exact[i]);
    CHECK(exact[i], "no memory");
  }
  formula(s, dsum, dmessages, exact);
  for (int i = SUM; i <= MESSAGES; i++)
    for (int64_t j = 0; j < r->size[i]; j++)
      CHECK(fabs((double)r->of[i][j] - exact[i][j]) <= error * (i == SUM ? (double)s->M + 1 : 1),
            "%s[%lld] is %g, not %g", names[i], (long long)j, (double)r->of[i][j], exact[i][j]);
  for (int i = 0; i < MESSAGE_RESULTS; i++) free(exact[i]);
}

static void fuzz(const ast_kernels *kernels) {
  const bool many = take_chance(); /* edges, so that the gradients go in several rounds */
  const int64_t most = many ? 3 : 65;
  ast_message s = {.S = 1 + take_size(60), .R = take_size(40), .E = take_size(many ? 2 : 17)};
  s.H = take_size(most), s.F = take_size(most), s.F2 = take_size(most);
  if (s.E && !s.H) s.E = s.F;
  const bool with_messages = take_byte() % 2;
  int64_t *offsets = take_offsets(s.R, 40);
  for (int64_t r = 0; many && r <= s.R; r++) offsets[r] += 400 * r;
  s.M = offsets[s.R];
  int64_t *senders = new_ints(s.M), *receivers = new_ints(s.M);
  check_state = take_word(2);
  for (int64_t m = 0, r = 0; m < s.M; m++) {
    while (offsets[r + 1] <= m) r++;
    receivers[m] = r;
    senders[m] = (int64_t)(random_bits() % (uint64_t)s.S);
  }
  s.senders = senders, s.receivers = receivers, s.receiver_offsets = offsets;
  s.of_senders = take_floats(s.S * s.F), s.of_receivers = take_floats(s.R * s.F),
  s.edge_features = take_floats(s.M * s.E);
  s.A1 = take_floats(s.H * s.E), s.a1 = take_floats(s.H), s.A2 = take_floats(s.F * s.H), s.W2 = take_floats(s.F2 * s.F);
  s.b2 = take_floats(s.F2), s.gamma = take_floats(s.F2), s.beta = take_floats(s.F2);
  const float *dsum = take_floats(s.R * s.F2), *dmessages = with_messages ? take_floats(s.M * s.F2) : NULL;
  const message_results r = solve_message(kernels, &s, dsum, dmessages);
  if (s.R) check_part(kernels, &s, dsum, dmessages, &r, take_index(s.R));
  check_values(&s, dsum, dmessages, &r);
  free_message_results(r);
  FREE(MESSAGE_BUFFERS(&s), dsum, dmessages);
}
