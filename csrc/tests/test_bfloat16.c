/* Products in bfloat16: by the instructions that this processor has, and in float32 where it has none.
 *
 * Factors that bfloat16 holds exactly give the bits of the float32 kernels, whatever the sizes. Others give what they
 * give when they were rounded before: the largest error is at most twice the error of plain float sums plus 1e-6 of the
 * largest value.
 */
#include "../integers.h"
#include "problems.h"

extern const ast_kernels ast_kernels_bfloat16_base;

static bool same_bits(const void *a, const void *b, int64_t floats) {
  return memcmp(a, b, (size_t)floats * sizeof(float)) == 0;
}

/* Whole numbers from -4 to 4 instead. */
static void make_whole(const float *x, int64_t n) {
  for (int64_t i = 0; i < n; i++) ((float *)(uintptr_t)x)[i] = (float)(int64_t)(random_bits() % 9) - 4;
}

static float *whole_floats(int64_t n) {
  float *x = new_floats(n);
  make_whole(x, n);
  return x;
}

/* The nearest number of 8 binary digits, of two the even one; subnormal numbers are 0. */
static float rounded(float x) {
  if (!isfinite(x)) return x;
  if (fabsf(x) < 0x1p-126f) return copysignf(0, x);
  int exponent;
  const float digits = frexpf(x, &exponent);
  return ldexpf(nearbyintf(digits * 256), exponent - 8);
}

/* ---- factors that need no rounding ---- */

static void check_linear(const ast_kernels *low, const ast_kernels *full, int64_t M, int64_t I, int64_t O,
                         ast_activation activation) {
  const int64_t columns = activation == AST_GEGLU ? O / 2 : O;
  const ast_linear s = {M, I, O, I, I, columns, columns, activation};
  float *x = whole_floats(M * I), *weight = whole_floats(O * I), *bias = whole_floats(O);
  float *residual = whole_floats(M * columns), *dout = whole_floats(M * columns);
  float *out[2], *z[2], *dx[2], *dweight[2], *dbias[2];
  for (int i = 0; i < 2; i++) {
    const ast_kernels *kernels = i ? full : low;
    out[i] = new_floats(M * columns), z[i] = new_floats(M * O), dx[i] = new_floats(M * I);
    dweight[i] = new_floats(O * I), dbias[i] = new_floats(O);
    CHECK(kernels->linear(&s, x, weight, bias, residual, out[i], z[i]) == AST_OK, "status");
    CHECK(kernels->linear_backward(&s, dout, x, weight, bias, z[i], dx[i], dweight[i], dbias[i]) == AST_OK, "status");
  }
  CHECK(same_bits(z[0], z[1], M * O), "z of %lld x %lld x %lld", (long long)M, (long long)I, (long long)O);
  if (activation != AST_GEGLU) { /* whose values and derivatives are no whole numbers */
    CHECK(same_bits(out[0], out[1], M * columns), "out");
    CHECK(same_bits(dx[0], dx[1], M * I), "dx of %lld x %lld x %lld", (long long)M, (long long)I, (long long)O);
    CHECK(same_bits(dweight[0], dweight[1], O * I) && same_bits(dbias[0], dbias[1], O), "dweight, dbias");
  }
  for (int i = 0; i < 2; i++) FREE(out[i], z[i], dx[i], dweight[i], dbias[i]);
  FREE(x, weight, bias, residual, dout);
}

static void check_mlp(const ast_kernels *low, const ast_kernels *full, int64_t M, int64_t I, int64_t I2, int64_t H,
                      int64_t O) {
  const int64_t K = I + I2;
  float *x = whole_floats(M * I), *beside = whole_floats(M * I2), *weight1 = whole_floats(H * K);
  float *bias1 = whole_floats(H), *weight2 = whole_floats(O * H), *bias2 = whole_floats(O);
  const ast_mlp s = {M, I, I2, H, O, I, I2, O, O, x, I2 ? beside : NULL, weight1, bias1, weight2, bias2, NULL, NULL};
  for (int64_t i = 0; i < O * H; i++) weight2[i] = weight2[i] > 0; /* sums that bfloat16 need not hold */
  for (int64_t i = 0; i < M * I; i++) x[i] = x[i] > 0;
  for (int64_t i = 0; i < M * I2; i++) beside[i] = beside[i] > 0;
  for (int64_t i = 0; i < H * K; i++) weight1[i] = (float)(random_bits() % 64 == 0);
  float *out[2];
  for (int i = 0; i < 2; i++) {
    out[i] = new_floats(M * O);
    CHECK((i ? full : low)->mlp(&s, NULL, out[i], (ast_mlp_kept){0}) == AST_OK, "status");
  }
  CHECK(same_bits(out[0], out[1], M * O), "mlp of %lld x %lld x %lld", (long long)M, (long long)H, (long long)O);
  FREE(x, beside, weight1, bias1, weight2, bias2, out[0], out[1]);
}

static void check_message(const ast_kernels *low, const ast_kernels *full, int64_t M, const int64_t *channels) {
  const ast_message s = new_message(M, 50, 40, channels[0], channels[1], channels[2], channels[3], 1);
  make_whole(s.of_senders, s.S * s.F), make_whole(s.of_receivers, s.R * s.F);
  make_whole(s.W2, s.F2 * s.F), make_whole(s.A2, s.F * s.H), make_whole(s.a1, s.H);
  for (int64_t i = 0; i < s.H * s.E; i++) ((float *)(uintptr_t)s.A1)[i] = (float)(random_bits() % 32 == 0);
  for (int64_t i = 0; i < s.F * s.H; i++) ((float *)(uintptr_t)s.A2)[i] = (float)(random_bits() % 64 == 0);
  make_whole(s.edge_features, s.M * s.E);
  float *sum = new_floats(s.R * s.F2), *expected = new_floats(s.R * s.F2);
  CHECK(low->message(&s, sum, NULL) == AST_OK && full->message(&s, expected, NULL) == AST_OK, "status");
  for (int64_t i = 0; i < s.R * s.F2; i++)
    CHECK(fabsf(sum[i] - expected[i]) <= 1e-5f * (1 + fabsf(expected[i])), "sum of %lld edges: %g, not %g",
          (long long)M, (double)sum[i], (double)expected[i]);
  FREE(sum, expected, MESSAGE_BUFFERS(&s));
}

static void check_conv(const ast_kernels *low, const ast_kernels *full, int64_t sources, int64_t destinations,
                       int64_t C_in, int64_t C_out, bool transposed) {
  const ast_pairs pairs = random_pairs(sources, destinations, 0.2, 1);
  float *x = whole_floats(sources * C_in), *weight = whole_floats(OFFSETS * C_in * C_out), *bias = whole_floats(C_out);
  float *out[2];
  for (int i = 0; i < 2; i++) {
    out[i] = new_floats(destinations * C_out);
    CHECK(
        (i ? full : low)->sparse_conv(x, weight, bias, C_in, C_out, transposed, pairs, destinations, out[i]) == AST_OK,
        "status");
  }
  CHECK(same_bits(out[0], out[1], destinations * C_out), "convolution of %lld to %lld channels", (long long)C_in,
        (long long)C_out);
  FREE(PAIR_BUFFERS(&pairs), x, weight, bias, out[0], out[1]);
}

static void test_exact_factors(const ast_kernels *low, const ast_kernels *full) {
  static const int64_t sizes[][3] = {{0, 40, 4},    {1, 32, 2},   {7, 33, 6},     {13, 64, 64},   {96, 32, 32},
                                     {97, 128, 30}, {200, 5, 12}, {300, 513, 70}, {31, 1100, 34}, {400, 96, 256}};
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    for (int activation = 0; activation < 3; activation++)
      check_linear(low, full, sizes[i][0], sizes[i][1], sizes[i][2], (ast_activation)activation);
  check_mlp(low, full, 100, 20, 30, 64, 33);
  check_mlp(low, full, 333, 40, 0, 128, 128);
  check_message(low, full, 1000, (const int64_t[]){8, 64, 64, 64});
  check_message(low, full, 97, (const int64_t[]){40, 33, 70, 34});
  check_message(low, full, 500, (const int64_t[]){64, 0, 64, 48});
  for (int transposed = 0; transposed < 2; transposed++) {
    check_conv(low, full, 40, 300, 5, 33, transposed); /* too few channels to be rounded */
    check_conv(low, full, 700, 129, 33, 30, transposed);
    check_conv(low, full, 60, 900, 64, 70, transposed);
    check_conv(low, full, 30, 50, 1100, 34, transposed); /* several chains */
    check_conv(low, full, 50, 3, 64, 150, transposed);   /* ranges of columns */
    check_conv(low, full, 0, 9, 64, 64, transposed);
  }
}

/* ---- factors that are rounded ---- */

/* Two scenes, the second one with a third of the queries and keys. Weights and values have 8 binary digits, so errors
 * of half a per cent are expected; dropped weights are the same. */
static void check_attention(const ast_kernels *low, const ast_kernels *full, int64_t queries, int64_t keys, int64_t D,
                            float dropout) {
  const int64_t H = 2, q_offsets[] = {0, queries, queries + queries / 3}, k_offsets[] = {0, keys, keys + keys / 3},
                rows = queries + queries / 3;
  const ast_attention s = {.B = 2,
                           .H = H,
                           .D = D,
                           .q_offsets = q_offsets,
                           .k_offsets = k_offsets,
                           .q_stride = H * D,
                           .k_stride = H * D,
                           .v_stride = H * D,
                           .scale = 1 / sqrtf((float)D),
                           .dropout_p = dropout};
  float *q = random_floats(rows * H * D), *k = scaled_floats((keys + keys / 3) * H * D, 3),
        *v = random_floats((keys + keys / 3) * H * D);
  float *out[2], *maximum[2], *sum[2];
  for (int i = 0; i < 2; i++) {
    out[i] = new_floats(rows * H * D), maximum[i] = new_floats(rows * H), sum[i] = new_floats(rows * H);
    CHECK((i ? full : low)->attention(&s, q, k, v, out[i], maximum[i], sum[i]) == AST_OK, "status");
  }
  double error = 0, size = 0;
  for (int64_t i = 0; i < (keys < 3 ? queries : rows) * H * D; i++) { /* a scene without keys gives 0 */
    error += pow((double)out[0][i] - (double)out[1][i], 2);
    size += pow((double)out[1][i], 2);
  }
  CHECK(error <= 0.01 * 0.01 * size, "attention of %lld x %lld x %lld is off by %g", (long long)queries,
        (long long)keys, (long long)D, sqrt(error / size));
  for (int i = 0; i < 2; i++) FREE(out[i], maximum[i], sum[i]);
  FREE(q, k, v);
}

static void test_attention(const ast_kernels *low, const ast_kernels *full) {
  static const int64_t sizes[][3] = {{1, 1, 16},    {5, 2, 32},     {33, 127, 48},
                                     {90, 129, 32}, {31, 300, 128}, {600, 40, 80}};
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    check_attention(low, full, sizes[i][0], sizes[i][1], sizes[i][2], i % 2 ? 0.25f : 0);
  check_attention(low, full, 4, 5000, 32, 0); /* parts, which are merged */
}

static void test_rounding(const ast_kernels *low) {
  const int64_t M = 130, I = 700, O = 50;
  const ast_linear s = {M, I, O, I, I, O, O, AST_IDENTITY};
  float *x = scaled_floats(M * I, 3), *weight = random_floats(O * I), *out = new_floats(M * O);
  double *exact = calloc((size_t)(M * O), sizeof *exact);
  float *plain = calloc((size_t)(M * O), sizeof *plain);
  CHECK(exact && plain, "no memory");
  x[0] = 1 + 0x1p-8f, x[1] = 1 + 3 * 0x1p-8f, x[2] = 1 + 0x1p-9f; /* ties */
  for (int64_t i = 0; i < M; i++)
    for (int64_t j = 0; j < O; j++)
      for (int64_t k = 0; k < I; k++) {
        const float a = rounded(x[i * I + k]), b = rounded(weight[j * I + k]);
        exact[i * O + j] += (double)a * (double)b, plain[i * O + j] += a * b;
      }
  CHECK(low->linear(&s, x, weight, NULL, NULL, out, NULL) == AST_OK, "status");
  check_accuracy("out", out, exact, plain, M * O);
  free(exact), free(plain);
  FREE(x, weight, out);
}

/* A subnormal number counts as 0, though the product would not. */
static void test_subnormal(const ast_kernels *low) {
  const ast_linear s = {1, 40, 2, 40, 40, 2, 2, AST_IDENTITY};
  float *x = whole_floats(40), *weight = whole_floats(80), *out = new_floats(2);
  for (int64_t i = 0; i < 40; i++) x[i] = i == 33 ? -1e-39f : 0;
  weight[33] = weight[73] = 1e38f;
  CHECK(low->linear(&s, x, weight, NULL, NULL, out, NULL) == AST_OK, "status");
  CHECK(out[0] == 0 && out[1] == 0, "%g", (double)out[0]);
  FREE(x, weight, out);
}

/* A row has the same bits wherever it stands and whoever computes it; one that is not finite touches no other. */
static void test_rows_alone(const ast_kernels *low) {
  const int64_t M = 700, I = 600, O = 70;
  ast_linear s = {M, I, O, I, I, O, O, AST_RELU};
  float *x = random_floats(M * I), *weight = random_floats(O * I), *all = new_floats(M * O), *one = new_floats(M * O);
  CHECK(low->linear(&s, x, weight, NULL, NULL, all, NULL) == AST_OK, "status");
  for (int64_t first = 0; first < M; first += 99) {
    s.M = min64(M - first, 1 + first / 9);
    CHECK(low->linear(&s, x + first * I, weight, NULL, NULL, one, NULL) == AST_OK, "status");
    CHECK(same_bits(one, all + first * O, s.M * O), "%lld rows alone", (long long)s.M);
  }
  s.M = M;
  x[333 * I + 5] = NAN, x[334 * I] = INFINITY;
  CHECK(low->linear(&s, x, weight, NULL, NULL, one, NULL) == AST_OK, "status");
  CHECK(same_bits(one, all, 333 * O) && same_bits(one + 335 * O, all + 335 * O, (M - 335) * O), "rows beside a NaN");
  for (int64_t j = 0; j < O; j++) CHECK(isnan(one[333 * O + j]), "a NaN is lost");
  FREE(x, weight, all, one);
}

/* A row of a convolution has the same bits whatever other rows there are, by any number of threads. */
static void test_conv_rows_alone(const ast_kernels *low) {
  const int64_t C_in = 70, C_out = 45, n = 600;
  const ast_pairs pairs = random_pairs(n, n, 0.3, 1);
  float *x = random_floats(n * C_in), *weight = random_floats(OFFSETS * C_in * C_out);
  float *all = new_floats(n * C_out), *first = new_floats(n * C_out);
  int64_t *source = new_ints(pairs.offsets[OFFSETS]), *destination = new_ints(pairs.offsets[OFFSETS]);
  int64_t offsets[OFFSETS + 1] = {0}, num = 0;
  for (int k = 0; k < OFFSETS; k++) { /* the pairs of the rows before the 200th */
    for (int64_t i = pairs.offsets[k]; i < pairs.offsets[k + 1]; i++)
      if (pairs.destination[i] < 200) source[num] = pairs.source[i], destination[num++] = pairs.destination[i];
    offsets[k + 1] = num;
  }
  const ast_pairs some = copy_pairs(offsets, source, destination);
  CHECK(low->sparse_conv(x, weight, NULL, C_in, C_out, false, pairs, n, all) == AST_OK, "status");
  CHECK(low->sparse_conv(x, weight, NULL, C_in, C_out, false, some, 200, first) == AST_OK, "status");
  CHECK(same_bits(first, all, 200 * C_out), "rows of a convolution alone");
  FREE(PAIR_BUFFERS(&pairs), PAIR_BUFFERS(&some), x, weight, all, first, source, destination);
}

static void test(const ast_kernels *low, const ast_kernels *full) {
  for (int threaded = 0; threaded < 2; threaded++) {
    check_state = 1;
    buffers_at_start = threaded;
    if (threaded) pool_start(CHECK_THREADS);
    test_exact_factors(low, full);
    test_attention(low, full);
    test_rounding(low);
    test_subnormal(low);
    test_rows_alone(low);
    test_conv_rows_alone(low);
    if (threaded) pool_stop();
    CHECK(num_buffers == 0, "%d buffers are not freed", num_buffers);
    printf("  %s, %d byte vectors, %s: passed\n", low->isa, low->vector_bytes, threaded ? "threads" : "serial");
  }
}

int main(void) {
  test(&ast_kernels_bfloat16_base, ast_select("base"));
  for (int i = 0; ast_bfloat16(i); i++) test(ast_bfloat16(i), ast_select("avx512"));
  return 0;
}
