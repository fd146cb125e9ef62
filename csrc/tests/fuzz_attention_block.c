/* Fuzzes attention_block and its gradients: a scene alone gives the bits that it gives among others, whatever the
 * others hold, and what is moderate stays finite. */
#include "problems.h"

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t B = 1 + take_size(3), H = 1 + take_byte() % 2, D = 16 * (1 + take_byte() % 3);
  const int64_t W = 1 + take_size(40), C = 1 + take_size(40), F = 1 + take_size(40);
  int64_t *q_offsets = take_offsets(B, 40), *k_offsets = take_offsets(B, 40);
  const ast_attention_block s = new_block(q_offsets, k_offsets, B, W, C, H, D, F, take_byte() % 2, take_floats);
  const float *dout = take_floats(s.Q * W);
  const block_results all = solve_block(kernels, &s, dout, B % 2);
  const int64_t b = take_index(B), q0 = q_offsets[b], k0 = k_offsets[b], Q = q_offsets[b + 1] - q0;
  int64_t *ends = new_ints(4);
  ends[0] = ends[2] = 0, ends[1] = Q, ends[3] = k_offsets[b + 1] - k0;
  ast_attention_block alone = s;
  alone.B = 1, alone.Q = Q, alone.K = ends[3], alone.q_offsets = ends, alone.k_offsets = ends + 2;
  alone.x += q0 * W, alone.context += k0 * C;
  if (s.rotations) alone.rotations += q0 * D, alone.context_rotations += k0 * D;
  const block_results part = new_block_results(&alone, B % 2);
  CHECK(kernels->attention_block(&alone, part.of[0], part.kept) == AST_OK, "status");
  CHECK(kernels->attention_block_backward(&alone, dout + q0 * W, part.kept, part.gradients) == AST_OK, "status");
  CHECK(same_floats(part.of[0], all.of[0] + q0 * W, Q * W), "scene %lld differs alone", (long long)b);
  CHECK(same_floats(part.of[1], all.of[1] + q0 * W, Q * W), "dx of scene %lld differs alone", (long long)b);
  CHECK(same_floats(part.of[2], all.of[2] + k0 * C, ends[3] * C), "dcontext of scene %lld differs alone", (long long)b);
  const float *const arrays[] = {s.x,
                                 s.context,
                                 s.rotations,
                                 s.context_rotations,
                                 s.gamma,
                                 s.beta,
                                 s.context_gamma,
                                 s.context_beta,
                                 s.query,
                                 s.key_value,
                                 s.weight,
                                 s.bias,
                                 s.inner_gamma,
                                 s.inner_beta,
                                 s.first,
                                 s.first_bias,
                                 s.second,
                                 s.second_bias,
                                 dout};
  const int64_t sizes[] = {s.Q * W,   s.K * C, s.Q * D, s.K * D, W,         W,     C,     C, H * D * W, 2 * H * D * C,
                           W * H * D, W,       W,       W,       2 * F * W, 2 * F, W * F, W, s.Q * W};
  bool moderate = true;
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    moderate &= !arrays[i] || (all_finite(arrays[i], sizes[i]) && largest_finite(arrays[i], sizes[i]) < 100);
  for (int i = 0; moderate && i < BLOCK_RESULTS; i++)
    CHECK(all_finite(all.of[i], all.size[i]), "%s is not finite", block_names[i]);
  FREE(BLOCK_BUFFERS(s), dout, ends);
  free_block_results(all), free_block_results(part);
}
