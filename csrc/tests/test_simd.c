/* The functions of simd.h against long double, on every instruction set: the worst error of each in units in the last
 * place.
 *
 * Floats are drawn evenly from all bit patterns of a domain, and evenly by value. One unit in the last place (ULP) is
 * the distance of neighbouring floats at the exact result.
 */
#include <float.h>
#include <stddef.h>

#include "check.h"
#include "simd_table.h"

static long double exact_exp(float x) { return expl(x); }
static long double exact_exp_shifted(float x) { return ldexpl(expl(x), -SIMD_SHIFT); }
static long double exact_gauss(float x) { return expl(-0.5L * x * x); }
static long double exact_density(float x) { return 0.398942280401432677939946L * expl(-0.5L * x * x); }
static long double exact_normal(float x) { return 0.5L * erfcl(-0.707106781186547524400844L * x); }

/* One function and domain: what it must hold. The domains end where results leave the normal floats. */
typedef struct {
  const char *name;
  size_t function; /* its place in simd_table */
  long double (*exact)(float x);
  float least, most;
  double bound; /* ULP */
} row;

#define AT(name) offsetof(simd_table, name)
/* Errors of the density count twice where the product with the constant has a smaller exponent. Phi to 1 ULP in its
 * tail would take q and v in two floats each; what uses it adds b Phi(b) to sums, where an error of 6 ULP at -1 is
 * below 1 ULP of b. */
static const row rows[] = {
    {"e^x", AT(exp), exact_exp, -86.6f, 88.0f, 1},
    {"e^x 2^-9", AT(exp_shifted), exact_exp_shifted, -80.4f, 88.0f, 1},
    {"e^(-x^2/2)", AT(gauss), exact_gauss, -13.2f, 13.2f, 1.01},
    {"normal density", AT(density), exact_density, -13.1f, 13.1f, 2.2},
    {"Phi(x)", AT(normal), exact_normal, 0.0f, 100.0f, 1.2},
    {"Phi(x)", AT(normal), exact_normal, -1.0f, 0.0f, 2.5},
    {"Phi(x)", AT(normal), exact_normal, -12.9f, -1.0f, 6},
};
#undef AT

/* Floats in ascending order are these integers in ascending order. */
static int64_t rank_of(float x) {
  int32_t bits;
  memcpy(&bits, &x, sizeof bits);
  return bits < 0 ? -(int64_t)(bits & INT32_MAX) : bits;
}
static float of_rank(int64_t rank) {
  const int32_t bits = (int32_t)(rank < 0 ? -rank | INT64_C(0x80000000) : rank);
  float x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

static double ulps(float got, long double exact) {
  int exponent;
  frexpl(exact, &exponent);
  return (double)(fabsl((long double)got - exact) / ldexpl(1, (exponent < -125 ? -125 : exponent) - 24));
}

static simd_function *function_of(const simd_table *table, const row *r) {
  simd_function *f;
  memcpy(&f, (const char *)table + r->function, sizeof f);
  return f;
}

static void check_row(const simd_table *table, const row *r, int64_t num) {
  enum { BLOCK = 1024 };
  float x[BLOCK], y[BLOCK], at = NAN;
  double worst = 0;
  const int64_t first = rank_of(r->least), ranks = rank_of(r->most) - first + 1;
  for (int64_t done = 0; done < num; done += BLOCK) {
    for (int i = 0; i < BLOCK; i++)
      x[i] = i % 2 ? r->least + (r->most - r->least) * (float)random_unit()
                   : of_rank(first + (int64_t)(random_bits() % (uint64_t)ranks));
    x[0] = r->least, x[1] = r->most;
    function_of(table, r)(x, y, BLOCK);
    for (int i = 0; i < BLOCK; i++) {
      const double error = ulps(y[i], r->exact(x[i]));
      if (!(error <= worst)) worst = error, at = x[i];
    }
  }
  printf("    %-16s [%6.1f, %5.1f]  %.2f ULP at %.9g\n", r->name, (double)r->least, (double)r->most, worst, (double)at);
#ifdef AST_UNFUSED
  const double bound = 1.5 * r->bound; /* products are rounded, too, where the kernels count on fused ones */
#else
  const double bound = r->bound;
#endif
  CHECK(worst <= bound, "%s is off by %g ULP, not %g, at %.9g", r->name, worst, bound, (double)at);
}

/* What lies outside of the domains. */
static void check_specials(const simd_table *table) {
  float x[SIMD_MOST_LANES] = {NAN,     -INFINITY, INFINITY, 0.0f, -0.0f, -200, 200,  -FLT_MAX,
                              FLT_MAX, 1e-40f,    -1e-40f,  -88,  -14,   14,   5.9f, -1e4f};
  float y[SIMD_MOST_LANES];
  table->exp(x, y, SIMD_MOST_LANES);
  CHECK(isnan(y[0]) && y[1] == 0 && y[3] == 1 && y[4] == 1 && y[5] == 0 && y[7] == 0 && y[9] == 1 && y[11] == 0 &&
            y[15] == 0,
        "e^x");
  table->gauss(x, y, SIMD_MOST_LANES);
  CHECK(isnan(y[0]) && y[3] == 1 && y[4] == 1 && y[9] == 1 && y[12] == 0 && y[13] == 0, "e^(-x^2/2)");
  CHECK(y[1] == 0 && y[2] == 0 && y[5] == 0 && y[6] == 0 && y[7] == 0 && y[8] == 0 && y[15] == 0, "e^(-x^2/2) far out");
  table->normal(x, y, SIMD_MOST_LANES);
  CHECK(isnan(y[0]) && y[1] == 0 && y[2] == 1 && y[3] == 0.5f && y[4] == 0.5f && y[5] == 0 && y[6] == 1, "Phi");
  CHECK(y[7] == 0 && y[8] == 1 && y[9] == 0.5f && y[12] == 0 && y[13] == 1 && y[14] == 1, "Phi far out");
}

extern const simd_table simd_table_base, simd_table_avx2, simd_table_avx512;

int main(void) {
  static const struct {
    const char *isa;
    const simd_table *table;
  } tables[] = {
      {"base", &simd_table_base},
#ifdef __x86_64__
      {"avx2", &simd_table_avx2},
      {"avx512", &simd_table_avx512},
#endif
  };
  const int64_t num = getenv("AST_TEST_QUICK") ? 1 << 14 : 1 << 21;
  for (size_t i = 0; i < sizeof tables / sizeof *tables; i++) {
    if (!ast_select(tables[i].isa)) continue;
    printf("  %s\n", tables[i].isa);
    for (size_t r = 0; r < sizeof rows / sizeof *rows; r++) check_row(tables[i].table, &rows[r], num);
    check_specials(tables[i].table);
  }
  return 0;
}
