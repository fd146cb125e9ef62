/* Where the surface of the nearest other body is.
 *
 * Each body has a tree of bounding boxes over its triangles, but only over triangles within the radius of a box around
 * the nodes of the other bodies. Triangles stand in the order of the Morton keys of their middles, and eight of them
 * are a leaf. A branch of the tree is a run of leaves, and its halves are its branches. A node looks for the nearest
 * point branch by branch, the nearer one first, and at no box that is farther away than what it has seen. The triangles
 * of a leaf are computed side by side, without branches: a processor would guess each second one wrong.
 *
 * The sign follows Baerentzen and Aanaes (IEEE TVCG 2005): the gap is negative behind the pseudonormal of the nearest
 * point, which is the normal of the triangle, of both triangles at an edge, or of all at a corner, weighted by their
 * angles there. Where a triangle is kept, so are all around each of its points that is within the radius of a node.
 *
 * Coordinates are float32 and computed with in double: their fourth powers, of which the tests below consist, neither
 * overflow nor vanish. Of equally near points that on the body with the lowest number counts, then that on the first
 * triangle. Every node is computed alone, so nothing depends on threads.
 */
#include <math.h>

#include "ast.h"
#include "simd.h"

enum {
  PROXIMITY_LEAF = 8,        /* triangles */
  PROXIMITY_CHUNK = 256,     /* nodes a task */
  PROXIMITY_DEPTH = 64,      /* of a tree at most */
  PROXIMITY_INDEX_BITS = 34, /* of a sorted word; the bits above are the Morton key of 3 x 10 bits */
  PROXIMITY_CELLS = 1024
};

static const double PROXIMITY_FLAT = 0x1p-48;     /* a triangle whose sine is below 2^-24 is a line: it has no normal */
static const double PROXIMITY_TOUCHING = 1e-9;    /* a gap below this share of the radius has no direction */
static const double PROXIMITY_FINE = 0.1;         /* the share of the radius where the last column saturates */
static const double PROXIMITY_ROUNDING = 0x1p-40; /* more than the rounding of the square of a distance */

typedef struct {
  double low[3], high[3];
} proximity_box;

typedef struct {
  double corner[3][3], normal[3]; /* the normal is as long as twice the area */
} proximity_triangle;

/* Triangles side by side; places behind the last one are NaN, and nothing is near them. */
typedef struct {
  double corner[3][3][PROXIMITY_LEAF], normal[3][PROXIMITY_LEAF];
  double of_edge[3][PROXIMITY_LEAF], of_normal[PROXIMITY_LEAF]; /* 1 over their squared lengths */
  int64_t number[PROXIMITY_LEAF];                               /* in the surface; -1 behind the last one */
} proximity_leaf;

/* Leaves [begin, end). The halves of a branch are the next branch and `right`; 0 where it has none. */
typedef struct {
  proximity_box box;
  int64_t begin, end, right;
} proximity_branch;

/* The leaves of a body, [begin, end); its tree starts at branch 2 begin. */
typedef struct {
  int64_t body, begin, end;
} proximity_surface;

typedef struct {
  const ast_proximity *s;
  float *out;
  int64_t *num_surfaces, *leaf_offsets; /* [B], [B+1]: where there is room for the leaves of each scene */
  proximity_surface *surfaces;          /* [F]: the surfaces of a scene start where its triangles start */
  proximity_leaf *leaves;
  proximity_branch *branches;
  double *middles;          /* [F,3], times 3 */
  uint64_t *sorted, *other; /* [F]: key << PROXIMITY_INDEX_BITS | place in `kept` */
  int64_t *kept;            /* [F]: numbers of triangles */
} proximity_job;

/* A point of a triangle: the squared distance to it, and the corners that are weighted in it, as bits. */
typedef struct {
  double place[3], square;
  int corners;
} proximity_point;

typedef struct {
  double square;
  int64_t surface, number; /* of the triangle; -1: there is none */
} proximity_nearest;

/* ---- vectors ---- */

AST_INLINE double proximity_dot(const double a[3], const double b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

AST_INLINE void proximity_way(const double from[3], const double to[3], double way[3]) {
  EACH(3, i) way[i] = to[i] - from[i];
}

AST_INLINE void proximity_cross(const double a[3], const double b[3], double c[3]) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

AST_INLINE void proximity_ahead(const ast_proximity *s, int64_t node, double x[3]) {
  EACH(3, i) x[i] = (double)s->position[3 * node + i] + (double)s->motion[3 * node + i];
}

static const proximity_box PROXIMITY_EMPTY = {{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};

AST_INLINE void proximity_include(proximity_box *box, const double low[3], const double high[3]) {
  EACH(3, i) {
    box->low[i] = low[i] < box->low[i] ? low[i] : box->low[i];
    box->high[i] = high[i] > box->high[i] ? high[i] : box->high[i];
  }
}

/* The squared distance of a point from a box. */
AST_INLINE double proximity_to_box(const double p[3], const proximity_box *box) {
  double square = 0;
  EACH(3, i) {
    const double below = box->low[i] - p[i], above = p[i] - box->high[i];
    double way = below > above ? below : above;
    way = way > 0 ? way : 0;
    square += way * way;
  }
  return square;
}

/* ---- trees ---- */

/* False if it is flat. */
static bool proximity_load(const ast_proximity *s, int64_t number, proximity_triangle *t) {
  double ab[3], ac[3];
  for (int k = 0; k < 3; k++) proximity_ahead(s, s->surface[3 * number + k], t->corner[k]);
  proximity_way(t->corner[0], t->corner[1], ab), proximity_way(t->corner[0], t->corner[2], ac);
  proximity_cross(ab, ac, t->normal);
  return proximity_dot(t->normal, t->normal) > PROXIMITY_FLAT * proximity_dot(ab, ab) * proximity_dot(ac, ac);
}

/* The branch of leaves [begin, end) and all below it, from place `at` on; the place behind them. */
static int64_t proximity_grow(const proximity_job *job, int64_t begin, int64_t end, int64_t at) {
  proximity_branch *branch = job->branches + at;
  *branch = (proximity_branch){PROXIMITY_EMPTY, begin, end, 0};
  if (end - begin == 1) {
    const proximity_leaf *leaf = job->leaves + begin;
    for (int lane = 0; lane < PROXIMITY_LEAF && leaf->number[lane] >= 0; lane++) EACH(3, k) {
        const double x[3] = {leaf->corner[k][0][lane], leaf->corner[k][1][lane], leaf->corner[k][2][lane]};
        proximity_include(&branch->box, x, x);
      }
    return at + 1;
  }
  const int64_t middle = begin + (end - begin) / 2, right = proximity_grow(job, begin, middle, at + 1);
  const int64_t behind = proximity_grow(job, middle, end, right);
  branch->right = right;
  proximity_include(&branch->box, branch[1].box.low, branch[1].box.high);
  proximity_include(&branch->box, job->branches[right].box.low, job->branches[right].box.high);
  return behind;
}

/* Sorts the n kept triangles from `begin` on by the Morton keys of their middles, within the box of the middles. */
static ast_status proximity_sort(const proximity_job *job, int64_t begin, int64_t n, const proximity_box *box) {
  AST_SCRATCH_SCOPE;
  double width = 0;
  EACH(3, i) width = box->high[i] - box->low[i] > width ? box->high[i] - box->low[i] : width;
  const double cells = width > 0 ? PROXIMITY_CELLS / width : 0, last = PROXIMITY_CELLS - 1;
  for (int64_t j = begin; j < begin + n; j++) {
    uint64_t key = 0;
    EACH(3, i) {
      double cell = (job->middles[3 * j + i] - box->low[i]) * cells;
      cell = cell < last ? cell : last;
      key |= octree_spread((uint64_t)(cell > 0 ? cell : 0)) << (2 - i);
    }
    job->sorted[j] = key << PROXIMITY_INDEX_BITS | (uint64_t)j;
  }
  const octree_rows rows = {job->sorted + begin, NULL}, spare = {job->other + begin, NULL};
  return octree_radix_sort(rows, spare, n, PROXIMITY_INDEX_BITS, 64, true);
}

static void proximity_fill_lane(const proximity_job *job, int64_t number, proximity_leaf *leaf, int lane) {
  proximity_triangle t;
  (void)proximity_load(job->s, number, &t);
  leaf->number[lane] = number;
  leaf->of_normal[lane] = 1 / proximity_dot(t.normal, t.normal);
  EACH(3, k) {
    double edge[3];
    proximity_way(t.corner[k], t.corner[(k + 1) % 3], edge);
    leaf->of_edge[k][lane] = 1 / proximity_dot(edge, edge);
    leaf->normal[k][lane] = t.normal[k];
    EACH(3, i) leaf->corner[k][i][lane] = t.corner[k][i];
  }
}

/* The leaves of the n sorted triangles from `begin` on. */
static void proximity_fill(const proximity_job *job, int64_t begin, int64_t n, proximity_leaf *leaves) {
  const uint64_t mask = ((uint64_t)1 << PROXIMITY_INDEX_BITS) - 1;
  memset(leaves, 0xff, (size_t)divide_up(n, PROXIMITY_LEAF) * sizeof *leaves); /* NaN and -1 */
  for (int64_t j = 0; j < n; j++)
    proximity_fill_lane(job, job->kept[job->sorted[begin + j] & mask], leaves + j / PROXIMITY_LEAF,
                        (int)(j % PROXIMITY_LEAF));
}

/* The triangles of a body that are near others of its scene, and their tree. They are kept from place `first` on; the
 * place behind them is returned in it. */
static ast_status proximity_keep(const proximity_job *job, int64_t scene, proximity_surface *surface, int64_t *first) {
  const ast_proximity *s = job->s;
  const double margin = s->radius * (1 + 0x1p-20);
  proximity_box others = PROXIMITY_EMPTY, middles = PROXIMITY_EMPTY;
  double x[3];
  for (int64_t node = s->offsets[scene]; node < s->offsets[scene + 1]; node++)
    if (s->body[node] != surface->body) proximity_ahead(s, node, x), proximity_include(&others, x, x);
  int64_t end = *first;
  for (int64_t number = s->surface_offsets[scene]; number < s->surface_offsets[scene + 1]; number++) {
    proximity_triangle t;
    if (s->body[s->surface[3 * number]] != surface->body || !proximity_load(s, number, &t)) continue;
    proximity_box box = PROXIMITY_EMPTY;
    for (int k = 0; k < 3; k++) proximity_include(&box, t.corner[k], t.corner[k]);
    bool near = true;
    EACH(3, i) near &= box.low[i] <= others.high[i] + margin && box.high[i] >= others.low[i] - margin;
    if (!near) continue;
    double *middle = job->middles + 3 * end;
    EACH(3, i) middle[i] = t.corner[0][i] + t.corner[1][i] + t.corner[2][i];
    proximity_include(&middles, middle, middle);
    job->kept[end++] = number;
  }
  const int64_t begin = *first, n = end - begin;
  surface->end = surface->begin + divide_up(n, PROXIMITY_LEAF);
  *first = end;
  if (!n) return AST_OK;
  const ast_status status = proximity_sort(job, begin, n, &middles);
  if (status != AST_OK) return status;
  proximity_fill(job, begin, n, job->leaves + surface->begin);
  (void)proximity_grow(job, surface->begin, surface->end, 2 * surface->begin);
  return AST_OK;
}

/* The bodies of a scene that have triangles, ascending. */
static ast_status proximity_bodies_task(int64_t scene, void *context) {
  const proximity_job *job = context;
  const ast_proximity *s = job->s;
  const int64_t first = s->surface_offsets[scene];
  proximity_surface *surfaces = job->surfaces + first;
  int64_t num = 0, at = 0;
  for (int64_t number = first; number < s->surface_offsets[scene + 1]; number++) {
    const int64_t body = s->body[s->surface[3 * number]];
    if (at < num && surfaces[at].body == body) continue;
    for (at = 0; at < num && surfaces[at].body < body; at++) {
    }
    if (at < num && surfaces[at].body == body) continue;
    for (int64_t k = num++; k > at; k--) surfaces[k] = surfaces[k - 1];
    surfaces[at].body = body;
  }
  job->num_surfaces[scene] = num;
  return AST_OK;
}

static ast_status proximity_trees_task(int64_t scene, void *context) {
  const proximity_job *job = context;
  int64_t first = job->s->surface_offsets[scene], leaf = job->leaf_offsets[scene];
  proximity_surface *surfaces = job->surfaces + first;
  for (int64_t k = 0; k < job->num_surfaces[scene]; k++) {
    surfaces[k].begin = leaf;
    const ast_status status = proximity_keep(job, scene, &surfaces[k], &first);
    if (status != AST_OK) return status;
    leaf = surfaces[k].end;
  }
  return AST_OK;
}

/* ---- the nearest point ---- */

/* Replaces `best` by the nearest point of the edge from corner a to corner b, if that is nearer. */
AST_INLINE void proximity_to_edge(const double p[3], const proximity_triangle *t, int a, int b, proximity_point *best) {
  double edge[3], way[3], rest[3];
  proximity_point point;
  proximity_way(t->corner[a], t->corner[b], edge), proximity_way(t->corner[a], p, way);
  const double along = proximity_dot(edge, way), whole = proximity_dot(edge, edge);
  const bool before = along <= 0, beyond = along >= whole;
  EACH(3, i) {
    const double between = t->corner[a][i] + along / whole * edge[i];
    point.place[i] = before ? t->corner[a][i] : beyond ? t->corner[b][i] : between;
  }
  point.corners = before ? 1 << a : beyond ? 1 << b : 1 << a | 1 << b;
  proximity_way(point.place, p, rest);
  point.square = proximity_dot(rest, rest);
  if (point.square < best->square) *best = point;
}

/* The nearest point of a triangle: above it if all weights of the corners are positive there, else on an edge. */
AST_INLINE proximity_point proximity_to_triangle(const double p[3], const proximity_triangle *t) {
  proximity_point best = {.square = INFINITY, .corners = 1};
  double weight[3];
  EACH(3, k) {
    double edge[3], way[3], area[3];
    proximity_way(t->corner[(k + 1) % 3], t->corner[(k + 2) % 3], edge);
    proximity_way(t->corner[(k + 1) % 3], p, way);
    proximity_cross(edge, way, area);
    weight[k] = proximity_dot(area, t->normal);
  }
  if (weight[0] > 0 && weight[1] > 0 && weight[2] > 0) {
    double way[3];
    proximity_way(t->corner[0], p, way);
    const double above = proximity_dot(t->normal, way), length = proximity_dot(t->normal, t->normal);
    EACH(3, i) best.place[i] = p[i] - above / length * t->normal[i];
    best.square = above / length * above;
    best.corners = 7;
    return best;
  }
  for (int k = 0; k < 3; k++) proximity_to_edge(p, t, k, (k + 1) % 3, &best);
  return best;
}

typedef double proximity_lanes __attribute__((vector_size(AST_VECTOR_BYTES), may_alias));
typedef int64_t proximity_mask __attribute__((vector_size(AST_VECTOR_BYTES)));
enum { PROXIMITY_LANES = AST_VECTOR_BYTES / 8 };

AST_INLINE proximity_lanes proximity_select(proximity_mask mask, proximity_lanes a, proximity_lanes b) {
  return (proximity_lanes)((mask & (proximity_mask)a) | (~mask & (proximity_mask)b));
}

/* The squared distances of a point from the triangles of a leaf: from the plane where the point lies above, else from
 * the nearest edge. */
AST_INLINE void proximity_to_leaf(const double p[3], const proximity_leaf *leaf, double squares[PROXIMITY_LEAF]) {
  const proximity_lanes zero = {0}, one = zero + 1;
  for (int lane = 0; lane < PROXIMITY_LEAF; lane += PROXIMITY_LANES) {
#define LANES(values) (*(const proximity_lanes *)((values) + lane))
    proximity_lanes x[3][3], normal[3], best = zero + INFINITY, above = zero;
    proximity_mask inside = zero == zero;
    EACH(3, i) {
      normal[i] = LANES(leaf->normal[i]);
      EACH(3, k) x[k][i] = LANES(leaf->corner[k][i]);
    }
    EACH(3, k) {
      proximity_lanes edge[3], way[3], side = zero, along = zero, square = zero;
      EACH(3, i) {
        edge[i] = x[(k + 1) % 3][i] - x[k][i];
        way[i] = p[i] - x[k][i];
        along += edge[i] * way[i];
      }
      EACH(3, i) side += normal[i] * (edge[(i + 1) % 3] * way[(i + 2) % 3] - edge[(i + 2) % 3] * way[(i + 1) % 3]);
      inside &= side > zero;
      along *= LANES(leaf->of_edge[k]);
      along = proximity_select(along > zero, along, zero);
      along = proximity_select(along < one, along, one);
      EACH(3, i) {
        const proximity_lanes rest = way[i] - along * edge[i];
        square += rest * rest;
      }
      best = proximity_select(square < best, square, best);
      if (k == 0) EACH(3, i) above += normal[i] * way[i];
    }
    const proximity_lanes result = proximity_select(inside, above * LANES(leaf->of_normal) * above, best);
    memcpy(squares + lane, &result, sizeof result);
#undef LANES
  }
}

/* Replaces `best` by the nearest triangle of a surface, if that is nearer. */
static void proximity_search(const proximity_job *job, int64_t number, const double p[3], proximity_nearest *best) {
  proximity_nearest nearest = {.square = best->square, .surface = number, .number = -1};
  int64_t waiting[PROXIMITY_DEPTH], num = 0, at = 2 * job->surfaces[number].begin;
  double squares[PROXIMITY_DEPTH], of_leaf[PROXIMITY_LEAF], square = proximity_to_box(p, &job->branches[at].box);
  for (;;) {
    if (square * (1 - PROXIMITY_ROUNDING) <= nearest.square) {
      const proximity_branch *branch = job->branches + at;
      if (branch->right) {
        const double left = proximity_to_box(p, &branch[1].box);
        const double right = proximity_to_box(p, &job->branches[branch->right].box);
        const bool swap = right < left;
        waiting[num] = swap ? at + 1 : branch->right, squares[num++] = swap ? left : right;
        at = swap ? branch->right : at + 1, square = swap ? right : left;
        continue;
      }
      const proximity_leaf *leaf = job->leaves + branch->begin;
      proximity_to_leaf(p, leaf, of_leaf);
      for (int lane = 0; lane < PROXIMITY_LEAF; lane++) {
        const bool tie = of_leaf[lane] == nearest.square && leaf->number[lane] < nearest.number;
        if (of_leaf[lane] < nearest.square || tie) nearest.square = of_leaf[lane], nearest.number = leaf->number[lane];
      }
    }
    if (!num) break;
    at = waiting[--num], square = squares[num];
  }
  if (nearest.number >= 0) *best = nearest;
}

/* The angle of a triangle at a corner. */
static double proximity_angle(const proximity_triangle *t, int k) {
  double one[3], other[3], cross[3];
  proximity_way(t->corner[k], t->corner[(k + 1) % 3], one), proximity_way(t->corner[k], t->corner[(k + 2) % 3], other);
  proximity_cross(one, other, cross);
  return atan2(sqrt(proximity_dot(cross, cross)), proximity_dot(one, other));
}

/* Adds the unit normal of a triangle to the pseudonormal if it has the corners with these bits of another triangle. */
static void proximity_add_normal(const ast_proximity *s, int64_t number, int64_t other, int corners, double sum[3]) {
  const int64_t *nodes = s->surface + 3 * number, *of_other = s->surface + 3 * other;
  int at = 0;
  for (int k = 0; k < 3; k++) {
    if (!(corners >> k & 1)) continue;
    for (at = 0; at < 3 && nodes[at] != of_other[k]; at++) {
    }
    if (at == 3) return;
  }
  proximity_triangle t;
  (void)proximity_load(s, number, &t);
  const bool alone = !(corners & (corners - 1));
  const double weight = (alone ? proximity_angle(&t, at) : 1) / sqrt(proximity_dot(t.normal, t.normal));
  EACH(3, i) sum[i] += weight * t.normal[i];
}

/* The pseudonormal at a point of a triangle, of length 1, or 0 where triangles cancel out. */
static void proximity_pseudonormal(const proximity_job *job, const proximity_nearest *nearest,
                                   const proximity_triangle *t, int corners, double normal[3]) {
  double sum[3] = {0};
  if (corners == 7) {
    EACH(3, i) sum[i] = t->normal[i];
  } else {
    const double *shared = t->corner[__builtin_ctz((unsigned)corners)]; /* all that are meant have this corner */
    int64_t waiting[PROXIMITY_DEPTH], num = 0;
    waiting[num++] = 2 * job->surfaces[nearest->surface].begin;
    while (num) {
      const int64_t at = waiting[--num];
      const proximity_branch *branch = job->branches + at;
      if (proximity_to_box(shared, &branch->box) > 0) continue;
      if (branch->right) {
        waiting[num++] = branch->right, waiting[num++] = at + 1;
        continue;
      }
      const int64_t *number = job->leaves[branch->begin].number;
      for (int lane = 0; lane < PROXIMITY_LEAF && number[lane] >= 0; lane++)
        proximity_add_normal(job->s, number[lane], nearest->number, corners, sum);
    }
  }
  const double length = sqrt(proximity_dot(sum, sum));
  EACH(3, i) normal[i] = length > 0 ? sum[i] / length : 0;
}

static void proximity_write(const proximity_job *job, const double p[3], const proximity_nearest *nearest, float *out) {
  const double radius = job->s->radius;
  double gap = radius, normal[3] = {0};
  proximity_triangle t;
  proximity_point point = {.square = INFINITY};
  if (nearest->number >= 0) (void)proximity_load(job->s, nearest->number, &t), point = proximity_to_triangle(p, &t);
  if (sqrt(point.square) < radius) {
    double way[3];
    proximity_way(point.place, p, way);
    proximity_pseudonormal(job, nearest, &t, point.corners, normal);
    gap = sqrt(point.square);
    gap = proximity_dot(way, normal) < 0 ? -gap : gap;
    if (fabs(gap) > PROXIMITY_TOUCHING * radius) EACH(3, i) normal[i] = way[i] / gap;
  }
  EACH(3, i) out[i] = (float)(normal[i] * (1 - fabs(gap) / radius));
  const double fine = gap / (PROXIMITY_FINE * radius);
  out[3] = (float)(gap / radius);
  out[4] = (float)(fine > 1 ? 1 : fine < -1 ? -1 : fine);
}

static ast_status proximity_node_task(int64_t index, void *context) {
  const proximity_job *job = context;
  const ast_proximity *s = job->s;
  const int64_t begin = index * PROXIMITY_CHUNK, end = min64(s->N, begin + PROXIMITY_CHUNK);
  int64_t scene = scene_at(s->offsets, s->B, begin);
  for (int64_t node = begin; node < end; node++) {
    while (s->offsets[scene + 1] <= node) scene++;
    proximity_nearest nearest = {.square = s->radius * s->radius, .number = -1};
    double p[3];
    proximity_ahead(s, node, p);
    for (int64_t k = 0; k < job->num_surfaces[scene]; k++) {
      const int64_t number = s->surface_offsets[scene] + k;
      const proximity_surface *surface = job->surfaces + number;
      if (surface->body != s->body[node] && surface->begin < surface->end) proximity_search(job, number, p, &nearest);
    }
    proximity_write(job, p, &nearest, job->out + 5 * node);
  }
  return AST_OK;
}

static ast_status proximity(const ast_proximity *s, float *restrict out) {
  AST_SCRATCH_SCOPE;
  const int64_t word = (int64_t)sizeof(int64_t), B = s->B, F = s->F;
  proximity_job job = {.s = s, .out = out};
  job.num_surfaces = ast_scratch(B * word), job.leaf_offsets = ast_scratch((B + 1) * word);
  job.surfaces = ast_scratch(F * (int64_t)sizeof *job.surfaces);
  job.sorted = ast_scratch(F * word), job.other = ast_scratch(F * word), job.kept = ast_scratch(F * word);
  job.middles = ast_scratch(3 * F * word);
  if (!job.num_surfaces || !job.leaf_offsets || !job.surfaces || !job.sorted || !job.other || !job.kept || !job.middles)
    return AST_NO_MEMORY;
  ast_status status = ast_parallel(B, proximity_bodies_task, &job);
  if (status != AST_OK) return status;
  job.leaf_offsets[0] = 0;
  for (int64_t b = 0; b < B; b++) {
    const int64_t triangles = s->surface_offsets[b + 1] - s->surface_offsets[b];
    job.leaf_offsets[b + 1] = job.leaf_offsets[b] + triangles / PROXIMITY_LEAF + job.num_surfaces[b];
  }
  job.leaves = ast_scratch(job.leaf_offsets[B] * (int64_t)sizeof *job.leaves);
  job.branches = ast_scratch(2 * job.leaf_offsets[B] * (int64_t)sizeof *job.branches);
  if (!job.leaves || !job.branches) return AST_NO_MEMORY;
  status = ast_parallel(B, proximity_trees_task, &job);
  return status == AST_OK ? ast_parallel(divide_up(s->N, PROXIMITY_CHUNK), proximity_node_task, &job) : status;
}
