/* Fuzzes attention_block: a scene alone gives the bits that it gives among others, whatever the others hold, and what is
 * moderate stays finite. */
#include "problems.h"

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t B = 1 + take_size(3), H = 1 + take_byte() % 2, D = 16 * (1 + take_byte() % 3);
  const int64_t W = 1 + take_size(40), C = 1 + take_size(40), F = 1 + take_size(40);
  int64_t *q_offsets = take_offsets(B, 40), *k_offsets = take_offsets(B, 40);
  const ast_attention_block s = new_block(q_offsets, k_offsets, B, W, C, H, D, F, take_byte() % 2, take_floats);
  float *out = new_floats(s.Q * W);
  CHECK(kernels->attention_block(&s, out) == AST_OK, "status");
  const int64_t b = take_index(B), q0 = q_offsets[b], k0 = k_offsets[b], Q = q_offsets[b + 1] - q0;
  int64_t *ends = new_ints(4);
  ends[0] = ends[2] = 0, ends[1] = Q, ends[3] = k_offsets[b + 1] - k0;
  ast_attention_block alone = s;
  alone.B = 1, alone.Q = Q, alone.K = ends[3], alone.q_offsets = ends, alone.k_offsets = ends + 2;
  alone.x += q0 * W, alone.context += k0 * C;
  if (s.rotations) alone.rotations += q0 * D, alone.context_rotations += k0 * D;
  float *part = new_floats(Q * W);
  CHECK(kernels->attention_block(&alone, part) == AST_OK, "status");
  CHECK(same_floats(part, out + q0 * W, Q * W), "scene %lld differs alone", (long long)b);
  const float *const arrays[] = {s.x,           s.context,    s.rotations,     s.context_rotations,
                                 s.gamma,       s.beta,       s.context_gamma, s.context_beta,
                                 s.query,       s.key_value,  s.weight,        s.bias,
                                 s.inner_gamma, s.inner_beta, s.first,         s.first_bias,
                                 s.second,      s.second_bias};
  const int64_t sizes[] = {s.Q * W,       s.K * C,   s.Q * D, s.K * D, W, W,         C,     C,     H * D * W,
                           2 * H * D * C, W * H * D, W,       W,       W, 2 * F * W, 2 * F, W * F, W};
  bool moderate = true;
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    moderate &= !arrays[i] || (all_finite(arrays[i], sizes[i]) && largest_finite(arrays[i], sizes[i]) < 100);
  CHECK(!moderate || all_finite(out, s.Q * W), "not finite");
  FREE(BLOCK_BUFFERS(s), out, ends, part);
}
