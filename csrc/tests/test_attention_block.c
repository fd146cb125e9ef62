/* attention_block and attention_block_backward against the formula in double, on every instruction set, serial and on
 * a pool.
 *
 * Accuracy: the largest error is at most twice the error of the formula in plain float plus 1e-6 of the largest value.
 */
#include "problems.h"

#define real    double
#define FORMULA formula
#include "formula_attention_block.h"
#define real    float
#define FORMULA formula_float
#include "formula_attention_block.h"

static const ast_attention_block_kept nothing;

static float *solve(const ast_kernels *kernels, const ast_attention_block *s) {
  float *out = new_floats(s->Q * s->W);
  READ_ONLY(BLOCK_BUFFERS(*s));
  CHECK(kernels->attention_block(s, out, nothing) == AST_OK, "status");
  WRITABLE(BLOCK_BUFFERS(*s));
  return out;
}

/* The offsets 0, the numbers, and the last of them again and again: scenes without vectors at the end. */
static int64_t *offsets_of(int64_t B, int64_t one, int64_t two) {
  int64_t *offsets = new_ints(B + 1);
  for (int64_t b = 0; b <= B; b++) offsets[b] = b == 0 ? 0 : b == 1 ? one : one + two;
  return offsets;
}

/* Sizes around every block, scenes without queries, without keys and without both. */
static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t sizes[][10] = {/* B, queries and keys of two scenes, W, C, H, D, F */
                                      {1, 1, 0, 1, 0, 1, 3, 1, 16, 1},       {2, 5, 3, 7, 11, 24, 17, 2, 16, 9},
                                      {3, 97, 1, 33, 2, 64, 64, 2, 32, 128}, {3, 0, 40, 9, 13, 33, 20, 3, 48, 20},
                                      {2, 7, 9, 0, 130, 16, 16, 1, 128, 16}, {0, 0, 0, 0, 0, 8, 8, 1, 16, 8}};
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    for (int rotated = 0; rotated < 2; rotated++) {
      const int64_t *n = sizes[i];
      const ast_attention_block s = new_block(offsets_of(n[0], n[1], n[2]), offsets_of(n[0], n[3], n[4]), n[0], n[5],
                                              n[6], n[7], n[8], n[9], rotated, random_floats);
      float *dout = random_floats(s.Q * s.W), *out = solve(kernels, &s);
      const block_results r = solve_block(kernels, &s, dout, i % 2);
      CHECK(memcmp(out, r.of[0], (size_t)r.size[0] * sizeof *out) == 0, "what is kept changes the result");
      bool fresh;
      uint64_t key = add_to_key((uint64_t)(2 * i) + (uint64_t)rotated, s.x, r.size[0] * (int64_t)sizeof *out);
      const formula_results *f = results_of(key, r.size, BLOCK_RESULTS, &fresh);
      if (fresh) formula(&s, dout, f->exact), formula_float(&s, dout, f->plain);
      for (int k = 0; k < BLOCK_RESULTS; k++)
        check_accuracy(block_names[k], r.of[k], f->exact[k], f->plain[k], r.size[k]);
      FREE(BLOCK_BUFFERS(s), dout, out);
      free_block_results(r);
    }
}

/* The second scene alone, and on any number of threads, has the same bits; a NaN in the first one does not reach it. */
static void test_same_bits(const ast_kernels *kernels) {
  enum { FIRST = 300, SECOND = 150, KEYS_1 = 40, KEYS_2 = 210, W = 40, C = 30, D = 16 };
  ast_attention_block s =
      new_block(offsets_of(2, FIRST, SECOND), offsets_of(2, KEYS_1, KEYS_2), 2, W, C, 2, D, 24, true, random_floats);
  float *out = solve(kernels, &s), *dout = random_floats((FIRST + SECOND) * W);
  const block_results all = solve_block(kernels, &s, dout, true);
  if (ast_threads() > 1) {
    ast_set_pool(NULL, NULL);
    const block_results serial = solve_block(kernels, &s, dout, true);
    ast_set_pool(pool_for, pool_threads);
    for (int k = 0; k < BLOCK_RESULTS; k++)
      CHECK(memcmp(serial.of[k], all.of[k], (size_t)all.size[k] * sizeof *out) == 0, "threads change %s",
            block_names[k]);
    free_block_results(serial);
  }
  ast_attention_block alone = s;
  alone.B = 1, alone.Q = SECOND, alone.K = KEYS_2;
  alone.q_offsets = offsets_of(1, SECOND, 0), alone.k_offsets = offsets_of(1, KEYS_2, 0);
  alone.x += FIRST * W, alone.context += KEYS_1 * C, alone.rotations += FIRST * D,
      alone.context_rotations += KEYS_1 * D;
  float *part = new_floats(SECOND * W);
  CHECK(kernels->attention_block(&alone, part, nothing) == AST_OK, "status");
  CHECK(memcmp(part, out + FIRST * W, SECOND * W * sizeof *out) == 0, "a scene alone differs");
  const block_results own = new_block_results(&alone, true);
  CHECK(kernels->attention_block(&alone, own.of[0], own.kept) == AST_OK, "status");
  CHECK(kernels->attention_block_backward(&alone, dout + FIRST * W, own.kept, own.gradients) == AST_OK, "status");
  CHECK(memcmp(own.of[1], all.of[1] + FIRST * W, SECOND * W * sizeof *out) == 0, "dx of a scene alone differs");
  CHECK(memcmp(own.of[2], all.of[2] + KEYS_1 * C, KEYS_2 * C * sizeof *out) == 0, "dcontext of a scene alone differs");
  ((float *)s.context)[0] = NAN;
  float *beside = solve(kernels, &s);
  CHECK(memcmp(part, beside + FIRST * W, SECOND * W * sizeof *out) == 0, "a NaN reaches another scene");
  for (int64_t i = 0; i < FIRST * W; i++) CHECK(isnan(beside[i]), "a NaN is lost");
  FREE(BLOCK_BUFFERS(s), alone.q_offsets, alone.k_offsets, out, dout, part, beside);
  free_block_results(all), free_block_results(own);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_same_bits(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
