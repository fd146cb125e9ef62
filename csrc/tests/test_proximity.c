/* proximity against all triangles in long double, on balls that overlap, on any triangles, and where a test by hand
 * knows the answer. */
#include "problems.h"

typedef long double real;

static real dot(const real a[3], const real b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void minus(const real a[3], const real b[3], real c[3]) {
  for (int i = 0; i < 3; i++) c[i] = a[i] - b[i];
}

static void cross(const real a[3], const real b[3], real c[3]) {
  for (int i = 0; i < 3; i++) c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

static void at_node(const ast_proximity *s, int64_t node, real x[3]) {
  for (int i = 0; i < 3; i++) x[i] = (real)s->position[3 * node + i] + (real)s->motion[3 * node + i];
}

/* The corners of a triangle and its normal, as long as twice the area; false if it is flat. */
static bool triangle_of(const ast_proximity *s, int64_t t, real x[3][3], real normal[3]) {
  real ab[3], ac[3];
  for (int k = 0; k < 3; k++) at_node(s, s->surface[3 * t + k], x[k]);
  minus(x[1], x[0], ab), minus(x[2], x[0], ac), cross(ab, ac, normal);
  return dot(normal, normal) > 0x1p-48L * dot(ab, ab) * dot(ac, ac);
}

/* The weights of the corners in the nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5). False
 * if rounding decides whether that lies on an edge or a corner. */
static bool weights_of(const real p[3], real x[3][3], real w[3]) {
  real ab[3], ac[3], ap[3], bp[3], cp[3];
  minus(x[1], x[0], ab), minus(x[2], x[0], ac), minus(p, x[0], ap), minus(p, x[1], bp), minus(p, x[2], cp);
  const real d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
  const real va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2, sum = va + vb + vc;
  real b = vb / sum, c = vc / sum;
  bool certain = fabsl(1 - b - c) > 1e-7L && fabsl(b) > 1e-7L && fabsl(c) > 1e-7L;
  if (d1 <= 0 && d2 <= 0) b = 0, c = 0;
  else if (d3 >= 0 && d4 <= d3) b = 1, c = 0;
  else if (d6 >= 0 && d5 <= d6) b = 0, c = 1;
  else if (vc <= 0 && d1 >= 0 && d3 <= 0) b = d1 / (d1 - d3), c = 0;
  else if (vb <= 0 && d2 >= 0 && d6 <= 0) b = 0, c = d2 / (d2 - d6);
  else if (va <= 0 && d4 >= d3 && d5 >= d6) c = (d4 - d3) / (d4 - d3 + d5 - d6), b = 1 - c;
  w[0] = 1 - b - c, w[1] = b, w[2] = c;
  for (int k = 0; k < 3; k++) certain &= w[k] <= 0 || w[k] > 1e-7L;
  return certain;
}

/* Whether the nearest points of two triangles lie on the same corner, edge or inside. */
static bool same_feature(const int64_t *nodes, const real w[3], const int64_t *others, const real v[3]) {
  int shared = 0, mine = 0, theirs = 0;
  for (int k = 0; k < 3; k++) {
    mine += w[k] > 0, theirs += v[k] > 0;
    for (int j = 0; j < 3; j++) shared += w[k] > 0 && v[j] > 0 && nodes[k] == others[j];
  }
  return shared == mine && mine == theirs && mine < 3;
}

/* Adds the normal of a triangle, if it has all corners of another one that have a weight. */
static void add_normal(const ast_proximity *s, int64_t t, int64_t other, const real w[3], real sum[3]) {
  real x[3][3], normal[3], one[3], two[3], weight = 1;
  int shared = 0, needed = 0, last = 0;
  if (!triangle_of(s, t, x, normal)) return;
  for (int k = 0; k < 3; k++) {
    if (!(w[k] > 0)) continue;
    needed++;
    for (int j = 0; j < 3; j++)
      if (s->surface[3 * t + j] == s->surface[3 * other + k]) shared++, last = j;
  }
  if (shared < needed) return;
  minus(x[(last + 1) % 3], x[last], one), minus(x[(last + 2) % 3], x[last], two);
  if (needed == 1) weight = acosl(fmaxl(-1, fminl(1, dot(one, two) / sqrtl(dot(one, one) * dot(two, two)))));
  for (int i = 0; i < 3; i++) sum[i] += weight * normal[i] / sqrtl(dot(normal, normal));
}

static void check_node(const ast_proximity *s, int64_t node, int64_t scene, const float *out, const char *what) {
  real p[3], place[3] = {0}, w[3], near[3] = {0}, normal[3] = {0}, length = INFINITY, runner = INFINITY, size = 0;
  int64_t best = -1;
  bool certain = false;
  at_node(s, node, p);
  for (int64_t t = s->surface_offsets[scene]; t < s->surface_offsets[scene + 1]; t++) {
    real x[3][3], unused[3], at[3], way[3];
    if (s->body[s->surface[3 * t]] == s->body[node] || !triangle_of(s, t, x, unused)) continue;
    const bool clear = weights_of(p, x, w);
    for (int i = 0; i < 3; i++) at[i] = w[0] * x[0][i] + w[1] * x[1][i] + w[2] * x[2][i];
    for (int i = 0; i < 9; i++) size = fmaxl(size, fabsl(x[i / 3][i % 3] - p[i % 3]));
    minus(p, at, way);
    const real distance = sqrtl(dot(way, way));
    minus(at, place, way);
    const bool same_place = best >= 0 && dot(way, way) <= 1e-20L * size * size;
    const int64_t *nodes = s->surface + 3 * t, *others = s->surface + 3 * (best < 0 ? t : best);
    const bool alike = same_place && s->body[*nodes] == s->body[*others] && same_feature(nodes, w, others, near);
    if (distance < length) {
      if (!alike) runner = length;
      certain = clear && (!alike || certain);
      best = t, length = distance, memcpy(place, at, sizeof place), memcpy(near, w, sizeof near);
    } else if (alike) {
      certain &= clear;
    } else if (distance < runner) {
      runner = distance;
    }
  }
  const real radius = s->radius, tolerance = 2e-6L + 1e-8L * fminl(size, 1e30L * radius) / radius;
  const real share = length < radius ? length / radius : 1;
  CHECK(fabsl(fabsl((real)out[3]) - share) <= tolerance, "%s, node %lld: the gap is %g, not %g", what, (long long)node,
        (double)out[3], (double)share);
  CHECK(fabsl((real)out[4] - fmaxl(-1, fminl(1, 10 * (real)out[3]))) <= 1e-5L, "%s: fine", what);
  /* The direction, where it is certain. */
  if (!certain || length >= radius * (1 - tolerance) || runner - length <= 1e-7L * size || length <= 1e-3L * size)
    return;
  real way[3], expected[3];
  for (int64_t t = s->surface_offsets[scene]; t < s->surface_offsets[scene + 1]; t++)
    if (s->body[s->surface[3 * t]] == s->body[s->surface[3 * best]]) add_normal(s, t, best, near, normal);
  minus(p, place, way);
  const real side = dot(way, normal);
  if (fabsl(side) <= 1e-6L * length) return;
  const bool touching = length <= 1e-9L * radius;
  for (int i = 0; i < 3; i++)
    expected[i] =
        (1 - share) * (touching ? normal[i] / sqrtl(dot(normal, normal)) : way[i] / (side < 0 ? -length : length));
  CHECK(fabsl((real)out[3] - (side < 0 ? -share : share)) <= tolerance, "%s, node %lld: the gap is %g, not %g", what,
        (long long)node, (double)out[3], (double)(side < 0 ? -share : share));
  for (int i = 0; i < 3; i++)
    CHECK(fabsl((real)out[i] - expected[i]) <= 1e-5L, "%s, node %lld: %g, not %g", what, (long long)node,
          (double)out[i], (double)expected[i]);
}

/* How many nodes are inside another body. */
static int64_t check_proximity(const ast_kernels *kernels, const ast_proximity *s, const char *what) {
  float *out = new_floats(5 * s->N);
  int64_t inside = 0;
  READ_ONLY(PROXIMITY_BUFFERS(s));
  CHECK(kernels->proximity(s, out) == AST_OK, "%s: status", what);
  for (int64_t scene = 0; scene < s->B; scene++)
    for (int64_t node = s->offsets[scene]; node < s->offsets[scene + 1]; node++) {
      check_node(s, node, scene, out + 5 * node, what);
      inside += out[5 * node + 3] < 0;
    }
  FREE(out);
  return inside;
}

static void test_balls(const ast_kernels *kernels, bool quick) {
  static const float scales[] = {1, 1e-30f, 1e30f, 1e-3f};
  int64_t inside = 0;
  for (int i = 0; i < 24; i++) {
    const ast_proximity s =
        new_balls(i % 4, 1 + i % 3, 1 + (i * 5) % (quick ? 7 : 13), scales[i % 4], i % 5 ? 0.2 : 10);
    inside += check_proximity(kernels, &s, "balls");
    FREE(PROXIMITY_BUFFERS(&s));
  }
  CHECK(inside > 50, "only %lld nodes are inside", (long long)inside);
}

/* Triangles of any nodes of a scene, on a coarse grid: nodes coincide, triangles are flat or share edges by chance. */
static void test_any_triangles(const ast_kernels *kernels) {
  for (int64_t F = 0; F < 200; F = 2 * F + 1)
    for (int grid = 2; grid < 200; grid *= 5) {
      enum { N = 60 };
      ast_proximity s = {.B = 1, .N = N, .F = F, .radius = 0.7};
      int64_t *body = new_ints(N), *surface = new_ints(3 * F);
      float *position = random_floats(3 * N), *motion = random_floats(3 * N);
      for (int64_t i = 0; i < 3 * N; i++) position[i] = roundf((float)grid * position[i]) / (float)grid, motion[i] = 0;
      for (int64_t i = 0; i < N; i++) body[i] = (int64_t)(random_bits() % 3);
      for (int64_t i = 0; i < 3 * F; i++) surface[i] = (int64_t)(random_bits() % N);
      s.offsets = copy_ints((const int64_t[]){0, N}, 2), s.surface_offsets = copy_ints((const int64_t[]){0, F}, 2);
      s.position = position, s.motion = motion, s.body = body, s.surface = surface;
      check_proximity(kernels, &s, "any triangles");
      FREE(PROXIMITY_BUFFERS(&s));
    }
}

/* Triangles of nodes 0 to 5 at z = 1 and z = -1; node 6 lies between them, and its body is the last. */
static void test_ties(const ast_kernels *kernels) {
  static const float x[] = {0, 0, 1, 9, 0, 1, 0, 9, 1, 0, 0, -1, 9, 0, -1, 0, 9, -1, 1, 1, 0};
  static const struct {
    int64_t bodies[2], num, triangles[9];
    double radius;
    float height, gap; /* of the normal, and the gap */
  } cases[] = {
      {{1, 2}, 3, {3, 4, 5, 0, 1, 2, 0, 2, 1}, 2, 0.5f, -0.5f}, /* the lower body, the first of two triangles */
      {{1, 2}, 3, {3, 4, 5, 0, 2, 1, 0, 1, 2}, 2, -0.5f, 0.5f},
      {{2, 1}, 3, {3, 4, 5, 0, 2, 1, 0, 1, 2}, 2, 0.5f, 0.5f},
      {{1, 1}, 2, {0, 1, 2, 3, 4, 5}, 2, 0.5f, -0.5f}, /* of one body, whichever lies lower */
      {{1, 1}, 2, {3, 4, 5, 0, 1, 2}, 2, 0.5f, 0.5f},
      {{1, 2}, 1, {3, 4, 5}, 2, 0.5f, 0.5f}, /* one triangle, */
      {{1, 2}, 1, {3, 4, 5}, 1, 0, 1},       /* which is no nearer than the radius */
      {{1, 2}, 0, {0}, 2, 0, 1},
      {{1, 2}, 2, {3, 3, 4, 1, 1, 1}, 2, 0, 1}, /* none of an area */
  };
  for (int i = 0; i < (int)(sizeof cases / sizeof *cases); i++) {
    ast_proximity s = {.B = 1, .N = 7, .F = cases[i].num, .radius = cases[i].radius};
    float *position = new_floats(21), *motion = new_floats(21), *out = new_floats(35);
    const int64_t one = cases[i].bodies[0], two = cases[i].bodies[1];
    memcpy(position, x, sizeof x), memset(motion, 0, 21 * sizeof *motion);
    s.position = position, s.motion = motion, s.surface = copy_ints(cases[i].triangles, 3 * s.F);
    s.offsets = copy_ints((const int64_t[]){0, 7}, 2), s.surface_offsets = copy_ints((const int64_t[]){0, s.F}, 2);
    s.body = copy_ints((const int64_t[]){one, one, one, two, two, two, 3}, 7);
    CHECK(kernels->proximity(&s, out) == AST_OK, "status");
    const float *last = out + 30, fine = cases[i].gap < 0 ? -1 : 1;
    CHECK(last[0] == 0 && last[1] == 0 && last[2] == cases[i].height && last[3] == cases[i].gap && last[4] == fine,
          "case %d: %g %g", i, (double)last[2], (double)last[3]);
    FREE(PROXIMITY_BUFFERS(&s), out);
  }
}

/* What node 3 has of the triangle of nodes 0 to 2. */
static void one_triangle(const ast_kernels *kernels, const float x[12], double radius, float out[5]) {
  ast_proximity s = {.B = 1, .N = 4, .F = 1, .radius = radius};
  float *position = new_floats(12), *motion = new_floats(12), *of_all = new_floats(20);
  memcpy(position, x, 12 * sizeof *x), memset(motion, 0, 12 * sizeof *motion);
  s.position = position, s.motion = motion, s.surface = copy_ints((const int64_t[]){0, 1, 2}, 3);
  s.offsets = copy_ints((const int64_t[]){0, 4}, 2), s.surface_offsets = copy_ints((const int64_t[]){0, 1}, 2);
  s.body = copy_ints((const int64_t[]){0, 0, 0, 1}, 4);
  CHECK(kernels->proximity(&s, of_all) == AST_OK, "status");
  memcpy(out, of_all + 15, 5 * sizeof *out);
  FREE(PROXIMITY_BUFFERS(&s), of_all);
}

/* A triangle that is flat but for the rounding of its corners has no direction that means anything: it does not count.
 * A vector that is no longer than rounding has none either: a node that touches has the normal. */
static void test_rounding(const ast_kernels *kernels) {
  const float b[3] = {1, 1.0f / 3, 1.0f / 7};
  float flat[12] = {[11] = 0.5f}, out[5];
  for (int i = 0; i < 3; i++) flat[3 + i] = 0.9f * b[i], flat[6 + i] = b[i];
  one_triangle(kernels, flat, 2, out);
  CHECK(out[3] == 1, "gap %g", (double)out[3]);
  const float touching[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, -1e-12f, -2e-12f, 1e-13f};
  one_triangle(kernels, touching, 1, out);
  CHECK(out[0] == 0 && out[1] == 0 && fabsf(out[2] - 1) < 1e-6f, "normal %g %g %g", (double)out[0], (double)out[1],
        (double)out[2]);
  one_triangle(kernels, touching, 1e-6, out);
  CHECK(out[1] < -0.89f && out[2] > 0.04f, "normal %g %g %g", (double)out[0], (double)out[1], (double)out[2]);
}

/* A node at a corner has the mean normal there, weighted by angles. */
static void test_at_a_corner(const ast_kernels *kernels) {
  ast_proximity s = new_balls(2, 2, 6, 1, 0.3);
  const int64_t *t = s.surface + 3 * 40, node = s.N - 1;
  float *position = (float *)s.position, *motion = (float *)s.motion, *out = new_floats(5 * s.N);
  const real corner[3] = {0, 1, 0};
  real normal[3] = {0};
  for (int64_t i = 0; i < 3 * s.N; i++) motion[i] = 0;
  for (int i = 0; i < 3; i++) position[3 * node + i] = position[3 * t[1] + i];
  CHECK(kernels->proximity(&s, out) == AST_OK, "status");
  CHECK(out[5 * node + 3] == 0 && out[5 * node + 4] == 0, "gap %g", (double)out[5 * node + 3]);
  for (int64_t other = 0; other < s.F; other++) add_normal(&s, other, 40, corner, normal);
  for (int i = 0; i < 3; i++)
    CHECK(fabsl((real)out[5 * node + i] - normal[i] / sqrtl(dot(normal, normal))) < 1e-6L, "normal[%d] is %g", i,
          (double)out[5 * node + i]);
  FREE(PROXIMITY_BUFFERS(&s), out);
}

static void test(const ast_kernels *kernels) {
  test_balls(kernels, getenv("AST_TEST_QUICK") != NULL);
  test_any_triangles(kernels);
  test_ties(kernels);
  test_rounding(kernels);
  test_at_a_corner(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
