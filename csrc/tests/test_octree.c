/* The octree against brute force: one floor and one bit loop a node, qsort for the order, and bsearch over all 27
 * offsets. */
#include <float.h>

#include "check.h"

static bool quick; /* where it is slow */

typedef struct {
  int64_t N, B, *offsets;
  float *positions;
} cloud;

typedef struct {
  int64_t *keys, *cell_offsets, *node_cell, *node_order, *node_offsets;
} tree;

static tree new_tree(int64_t N, int64_t B) {
  return (tree){new_ints(N), new_ints(B + 1), new_ints(N), new_ints(N), new_ints(N + 1)};
}

static void free_tree(tree t) { FREE(t.keys, t.cell_offsets, t.node_cell, t.node_order, t.node_offsets); }

/* ---- oracle of the build ---- */

static int64_t interleave(const int64_t cell[3]) {
  int64_t key = 0;
  for (int bit = 0; bit < 21; bit++)
    for (int a = 0; a < 3; a++) key |= (cell[a] >> bit & 1) << (3 * bit + 2 - a);
  return key;
}

static void separate(int64_t key, int64_t cell[3]) {
  for (int a = 0; a < 3; a++) cell[a] = 0;
  for (int bit = 0; bit < 21; bit++)
    for (int a = 0; a < 3; a++) cell[a] |= (key >> (3 * bit + 2 - a) & 1) << bit;
}

static int64_t key_of(const float p[3], const double center[3], double half_width, int depth) {
  int64_t cell[3];
  const int64_t last = ((int64_t)1 << depth) - 1;
  for (int a = 0; a < 3; a++) {
    cell[a] = (int64_t)floor(((double)p[a] - center[a] + half_width) / (2 * half_width) * ldexp(1, depth));
    cell[a] = cell[a] < 0 ? 0 : cell[a] > last ? last : cell[a];
  }
  return interleave(cell);
}

typedef struct {
  int64_t scene, key, node;
} entry;

static int by_scene_key_node(const void *a, const void *b) {
  const entry *x = a, *y = b;
  if (x->scene != y->scene) return x->scene < y->scene ? -1 : 1;
  if (x->key != y->key) return x->key < y->key ? -1 : 1;
  return x->node < y->node ? -1 : x->node > y->node;
}

static void check_build(const ast_kernels *kernels, cloud s, const double center[3], double half_width, int depth,
                        const char *what) {
  tree t = new_tree(s.N, s.B);
  int64_t bad = -1, c = -1;
  READ_ONLY(s.positions, s.offsets);
  CHECK(kernels->octree_build(s.positions, s.offsets, s.B, center, half_width, depth, t.keys, t.cell_offsets,
                              t.node_cell, t.node_order, t.node_offsets, &bad) == AST_OK,
        "%s", what);
  WRITABLE(s.positions, s.offsets);
  entry *sorted = malloc((size_t)(s.N + 1) * sizeof *sorted);
  for (int64_t b = 0; b < s.B; b++)
    for (int64_t i = s.offsets[b]; i < s.offsets[b + 1]; i++)
      sorted[i] = (entry){b, key_of(s.positions + 3 * i, center, half_width, depth), i};
  qsort(sorted, (size_t)s.N, sizeof *sorted, by_scene_key_node);
  for (int64_t i = 0, b = 0; i <= s.N; i++) {
    const bool head =
        i == s.N || i == 0 || sorted[i].scene != sorted[i - 1].scene || sorted[i].key != sorted[i - 1].key;
    c += head;
    for (; b <= s.B && s.offsets[b] <= i; b++)
      CHECK(t.cell_offsets[b] == (s.offsets[b] == s.N ? t.cell_offsets[s.B] : c), "%s: scene %lld", what, (long long)b);
    if (head) CHECK(t.node_offsets[c] == i, "%s: cell %lld", what, (long long)c);
    if (i == s.N) break;
    CHECK(t.keys[c] == sorted[i].key, "%s: cell %lld", what, (long long)c);
    CHECK(t.node_order[i] == sorted[i].node, "%s: place %lld", what, (long long)i);
    CHECK(t.node_cell[sorted[i].node] == c, "%s: node %lld", what, (long long)sorted[i].node);
  }
  CHECK(t.cell_offsets[s.B] == c, "%s: %lld cells, not %lld", what, (long long)t.cell_offsets[s.B], (long long)c);
  int32_t *coordinates = new_small_ints(3 * c);
  int64_t *keys = copy_ints(t.keys, c);
  READ_ONLY(keys);
  CHECK(kernels->octree_coordinates(keys, c, coordinates) == AST_OK, "%s", what);
  for (int64_t i = 0; i < c; i++) {
    int64_t cell[3];
    separate(t.keys[i], cell);
    for (int a = 0; a < 3; a++) CHECK(coordinates[3 * i + a] == cell[a], "%s: cell %lld", what, (long long)i);
  }
  free(sorted);
  FREE(coordinates, keys);
  free_tree(t);
}

/* ---- oracle of the coarser level and its pairs ---- */

static int by_value(const void *a, const void *b) {
  const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return x < y ? -1 : x > y;
}

static int64_t find(const int64_t *keys, const int64_t *offsets, int64_t scene, const int64_t cell[3]) {
  for (int a = 0; a < 3; a++)
    if (cell[a] < 0 || cell[a] >= 1 << 21) return -1;
  const int64_t key = interleave(cell);
  const int64_t *at =
      bsearch(&key, keys + offsets[scene], (size_t)(offsets[scene + 1] - offsets[scene]), sizeof key, by_value);
  return at ? at - keys : -1;
}

/* The cells of a level, its cells before each cell, and node_cell, from the keys of the finer level. */
static void check_cells(const ast_octree_level *s, const int64_t *keys, const int64_t *offsets, tree t,
                        const char *what) {
  int64_t C = 0, cell[3], other[3];
  for (int64_t b = 0; b < s->B; b++) {
    CHECK(t.cell_offsets[b] == C, "%s: scene %lld", what, (long long)b);
    for (int64_t f = offsets[b]; f < offsets[b + 1]; f++) {
      const bool first = f == offsets[b] || keys[f] >> 3 != keys[f - 1] >> 3;
      if (first) CHECK(t.keys[C] == keys[f] >> 3 && t.node_offsets[C] == f, "%s: coarse cell %lld", what, (long long)C);
      C += first;
      CHECK(t.node_cell[f] == C - 1, "%s: fine cell %lld", what, (long long)f);
    }
  }
  CHECK(s->C == C && t.cell_offsets[s->B] == C && t.node_offsets[C] == offsets[s->B], "%s", what);
  CHECK(s->C_fine == offsets[s->B] && s->pair_offsets[0] == 0, "%s", what);
  for (int64_t b = 0; b < s->B; b++)
    for (int64_t P = t.cell_offsets[b]; P < t.cell_offsets[b + 1]; P++) {
      bool near = false;
      for (int d = 0; d < 8; d++) {
        separate(t.keys[P], cell);
        for (int a = 0; a < 3; a++) other[a] = cell[a] - (d >> (2 - a) & 1);
        const int64_t Q = find(t.keys, t.cell_offsets, b, other);
        if (s->near[P]) CHECK(s->before[P][d] == Q, "%s: cell %lld, neighbour %d", what, (long long)P, d);
        near |= d && Q >= 0;
      }
      CHECK(s->near[P] == near, "%s: cell %lld", what, (long long)P);
    }
}

/* The pairs of a level, by coarse and by fine cell. */
static void check_pairs(const ast_octree_level *s, const int64_t *keys, const int64_t *offsets, tree t,
                        int64_t *const pair[4], const char *what) {
  int64_t cell[3], other[3], pairs = 0;
  for (int64_t k = 0, by_fine = 0; k < 27; k++) {
    const int64_t step[3] = {k / 9 - 1, k / 3 % 3 - 1, k % 3 - 1};
    for (int64_t b = 0; b < s->B; b++) {
      for (int64_t P = t.cell_offsets[b]; P < t.cell_offsets[b + 1]; P++) {
        separate(t.keys[P], cell);
        for (int a = 0; a < 3; a++) other[a] = 2 * cell[a] + step[a];
        const int64_t f = find(keys, offsets, b, other);
        if (f < 0) continue;
        CHECK(pair[0][pairs] == f && pair[1][pairs] == P, "%s: offset %lld, coarse cell %lld", what, (long long)k,
              (long long)P);
        pairs++;
      }
      for (int64_t f = offsets[b]; f < offsets[b + 1]; f++) {
        separate(keys[f], cell);
        bool whole = true;
        for (int a = 0; a < 3; a++) {
          whole &= (cell[a] - step[a]) % 2 == 0;
          other[a] = (cell[a] - step[a]) / 2;
        }
        const int64_t P = whole ? find(t.keys, t.cell_offsets, b, other) : -1;
        if (P < 0) continue;
        CHECK(pair[2][by_fine] == f && pair[3][by_fine] == P, "%s: offset %lld, fine cell %lld", what, (long long)k,
              (long long)f);
        by_fine++;
      }
    }
    CHECK(s->pair_offsets[k + 1] == pairs && pairs == by_fine, "%s: offset %lld has %lld pairs", what, (long long)k,
          (long long)pairs);
  }
}

/* Level by level from the cells of t, whose other arrays are not read; frees it. */
static void check_levels_of(const ast_kernels *kernels, tree t, int64_t B, int levels, const char *what) {
  AST_SCRATCH_SCOPE; /* of the levels */
  ast_octree_level level[21];
  READ_ONLY(t.keys, t.cell_offsets);
  CHECK(kernels->octree_coarsen(t.keys, t.cell_offsets, B, levels, level) == AST_OK, "%s", what);
  WRITABLE(t.keys, t.cell_offsets);
  for (int j = 0; j < levels; j++) {
    tree coarser = {new_ints(level[j].C), new_ints(B + 1), new_ints(level[j].C_fine), new_ints(0),
                    new_ints(level[j].C + 1)};
    int64_t *pair[4];
    for (int i = 0; i < 4; i++) pair[i] = new_ints(level[j].pair_offsets[27]);
    CHECK(kernels->octree_write_level(&level[j], coarser.keys, coarser.cell_offsets, coarser.node_offsets,
                                      coarser.node_cell, pair[0], pair[1], pair[2], pair[3]) == AST_OK,
          "%s", what);
    check_cells(&level[j], t.keys, t.cell_offsets, coarser, what);
    check_pairs(&level[j], t.keys, t.cell_offsets, coarser, pair, what);
    FREE(pair[0], pair[1], pair[2], pair[3]);
    free_tree(t);
    t = coarser;
  }
  free_tree(t);
}

static void check_levels(const ast_kernels *kernels, cloud s, const double center[3], double half_width, int depth,
                         int levels, const char *what) {
  tree t = new_tree(s.N, s.B);
  int64_t bad;
  READ_ONLY(s.positions, s.offsets);
  CHECK(kernels->octree_build(s.positions, s.offsets, s.B, center, half_width, depth, t.keys, t.cell_offsets,
                              t.node_cell, t.node_order, t.node_offsets, &bad) == AST_OK,
        "%s", what);
  WRITABLE(s.positions, s.offsets);
  int64_t *all_keys = t.keys;
  t.keys = copy_ints(all_keys, t.cell_offsets[s.B]);
  FREE(all_keys);
  check_levels_of(kernels, t, s.B, levels, what);
}

/* ---- clouds ---- */

static cloud new_cloud(int64_t N, int64_t B) {
  cloud s = {N, B, new_ints(B + 1), new_floats(3 * N)};
  s.offsets[0] = 0;
  for (int64_t b = 1; b <= B; b++) /* some scenes are empty; the last takes the rest */
    s.offsets[b] = b == B ? N : b % 3 == 2 ? s.offsets[b - 1] : s.offsets[b - 1] + (N - s.offsets[b - 1]) / 2;
  return s;
}

static void free_cloud(cloud s) { FREE(s.offsets, s.positions); }

enum { RANDOM, COINCIDENT, COLLINEAR, PLANAR, LATTICE, EDGES, SPHERE, SHAPES };
static const char *const shapes[] = {"random", "coincident", "collinear", "planar", "lattice", "edges", "sphere"};

static void fill(cloud s, int shape, int depth) {
  const float fixed = random_float();
  for (int64_t i = 0; i < s.N; i++) {
    float *p = s.positions + 3 * i;
    for (int a = 0; a < 3; a++) p[a] = random_float();
    if (shape == COINCIDENT) p[0] = p[1] = p[2] = fixed;
    if (shape == COLLINEAR) p[1] = p[2] = p[0];
    if (shape == PLANAR) p[2] = fixed;
    if (shape == SPHERE) {
      const float r = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) + 1e-6f;
      for (int a = 0; a < 3; a++) p[a] *= 0.9f / r;
    }
    for (int a = 0; a < 3 && (shape == LATTICE || shape == EDGES); a++) { /* on the faces of cells, the far ones too */
      const int cells = 1 << (depth < 12 ? depth : 12);
      p[a] = (float)((double)(random_bits() % (uint64_t)(cells + 1)) * 2 / cells - 1);
      if (shape == EDGES) p[a] = random_bits() & 1 ? nextafterf(p[a], -2) : nextafterf(p[a], 2);
    }
  }
}

static void test_shapes(const ast_kernels *kernels) {
  static const int64_t sizes[] = {0, 1, 2, 3, 63, 65, 129, 8193};
  const int last = quick ? 7 : 8;
  static const int depths[] = {0, 1, 5, 12, 21};
  static const int64_t scenes[] = {1, 2, 7};
  const double origin[3] = {0, 0, 0};
  for (int n = 0; n < last; n++)
    for (int d = 0; d < 5; d++)
      for (int shape = 0; shape < SHAPES; shape++) {
        cloud s = new_cloud(sizes[n], scenes[(n + d + shape) % 3]);
        fill(s, shape, depths[d]);
        check_build(kernels, s, origin, 1, depths[d], shapes[shape]);
        if (sizes[n] < 1000)
          check_levels(kernels, s, origin, 1, depths[d], depths[d] < 21 ? depths[d] + 1 : 21, shapes[shape]);
        free_cloud(s);
      }
}

/* Several chunks of coarse cells, blocks cut by them, dense and sparse levels. */
static void test_chunks(const ast_kernels *kernels) {
  const double origin[3] = {0, 0, 0};
  cloud s = new_cloud(quick ? 9000 : 20000, 3);
  fill(s, SPHERE, 12);
  check_build(kernels, s, origin, 1, 12, "large sphere");
  check_levels(kernels, s, origin, 1, 9, 3, "large sphere");
  fill(s, RANDOM, 5);
  check_levels(kernels, s, origin, 1, 5, 2, "filled cube");
  free_cloud(s);
}

static void test_values(const ast_kernels *kernels) {
  static const float values[] = {0.0f,          -0.0f,          1.0f,     -1.0f,          1e-40f,
                                 -1e-40f,       FLT_MIN,        -FLT_MIN, 0x1.fffffep-1f, -0x1.fffffep-1f,
                                 1.0000019073f, -1.0000019073f, 0.5f,     1.0f / 3};
  enum { NUM = sizeof values / sizeof *values };
  const double origin[3] = {0, 0, 0}, center[3] = {0.1, -2, 1e-3};
  cloud s = new_cloud(NUM * NUM, 4);
  for (int64_t i = 0; i < s.N; i++)
    for (int a = 0; a < 3; a++) s.positions[3 * i + a] = values[(i / (a == 0 ? NUM : 1) + a * 5) % NUM];
  for (int depth = 0; depth <= 21; depth++) check_build(kernels, s, origin, 1, depth, "special values");
  for (int64_t i = 0; i < 3 * s.N; i++) s.positions[i] = (float)center[i % 3] + 1e-30f * random_float();
  check_build(kernels, s, center, 7.5, 13, "near the center");
  for (int64_t i = 0; i < 3 * s.N; i++) s.positions[i] = FLT_MAX * random_float();
  check_build(kernels, s, origin, (double)FLT_MAX, 21, "the whole float range");
  for (int64_t i = 0; i < 3 * s.N; i++) s.positions[i] = 1e-40f * random_float();
  check_build(kernels, s, origin, 1e-40, 21, "subnormal cube");
  free_cloud(s);
}

static void test_errors(const ast_kernels *kernels) {
  static const float wrong[] = {NAN, INFINITY, -INFINITY, FLT_MAX, 1.000003f, -1.000003f};
  const double origin[3] = {0, 0, 0};
  const int64_t N = 20001;
  cloud s = new_cloud(N, 3);
  tree t = new_tree(N, 3);
  for (int i = 0; i < 6; i++)
    for (int64_t first = 0; first < N; first += first < 70 && !quick ? 1 : 4987) {
      int64_t bad = -1;
      if (first % 32 == 0) fill(s, RANDOM, 5);
      s.positions[3 * first + i % 3] = wrong[i];
      if (first + 1 < N) s.positions[3 * first + 3] = wrong[(i + 3) % 6];
      const ast_status status = kernels->octree_build(s.positions, s.offsets, s.B, origin, 1, 9, t.keys, t.cell_offsets,
                                                      t.node_cell, t.node_order, t.node_offsets, &bad);
      CHECK(status == (isfinite(wrong[i]) ? AST_OUTSIDE : AST_NOT_FINITE) && bad == first,
            "value %g at node %lld: status %d at %lld", (double)wrong[i], (long long)first, (int)status,
            (long long)bad);
      memset(s.positions + 3 * first, 0, (first + 1 < N ? 6 : 3) * sizeof(float));
    }
  free_tree(t), free_cloud(s);
}

static void test_no_scenes(const ast_kernels *kernels) {
  const double origin[3] = {0, 0, 0};
  cloud s = new_cloud(0, 0);
  check_build(kernels, s, origin, 1, 3, "no scenes");
  check_levels(kernels, s, origin, 1, 3, 4, "no scenes");
  free_cloud(s);
}

static void test(const ast_kernels *kernels) {
  test_no_scenes(kernels);
  test_values(kernels);
  test_errors(kernels);
  test_shapes(kernels);
  test_chunks(kernels);
}

int main(void) {
  quick = getenv("AST_TEST_QUICK") != NULL;
  on_every_table(test);
  return 0;
}
