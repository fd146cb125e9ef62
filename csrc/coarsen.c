/* The coarser levels of an octree, all at once, and which of their cells are neighbours.
 *
 * Level 0 holds the given cells, level j+1 the parents of the cells of level j, the root R one cell a scene. Legend:
 * P a cell, o = 4x+2y+z its octant (the low three bits of its key), d = 4i+2j+k a step of 0 or 1 along each axis.
 *
 * Cells. Cell i of level 0 starts new cells at levels 1..q, where q is the highest octal digit in which its key differs
 * from the one before it; q = R where a scene starts. Counting each q by chunks tells where the cells of every level
 * go, and one more pass writes them: of its parents cell i is the first child up to level q, and a further child at
 * level q+1.
 *
 * Neighbours, from the root down. Octant o of P, moved by -d, is octant o^d of the cell at -(d & ~o) from P (the axes
 * that borrow). So children find the cells before them among the children of P and of the cells before P, without a
 * search. The children of these eight cells are 64 bits, byte d for the cell at -d; one child's eight neighbours are
 * found in them at once. In a sparse level most cells are passed over: the lone child of a cell without neighbours has
 * none.
 *
 * Cost: a few ns for each cell of each level up to the root. Work is cut into chunks as in octree.c, which holds what
 * the two share.
 */
#include "ast.h"
#include "simd.h"

enum { OCTREE_LEVELS = 22, OCTREE_GROUPS = 27 }; /* the given level and at most 21 above it: a key has 63 bits */

AST_INLINE unsigned octree_octants(int64_t family) { return (unsigned)family & 255; }
AST_INLINE int64_t octree_first(int64_t family) { return family >> 8; }

/* ---- cells ---- */

typedef struct {
  int64_t next[OCTREE_LEVELS];   /* first the cells of the chunk by q; then where its next cell of each level goes */
  uint8_t before[OCTREE_LEVELS]; /* octants for the last parent of each level that started in an earlier chunk */
} octree_chunk;

typedef struct {
  const int64_t *keys, *offsets;
  int64_t B, C;
  int root, levels;
  octree_chunk *chunks;
  const ast_octree_level *level;
} octree_cells_job;

/* The levels above the given one at which cell i starts a cell; b is its scene. */
AST_INLINE int octree_starts(const octree_cells_job *job, int64_t i, int64_t b) {
  if (i == job->offsets[b]) return job->root;
  return (63 - __builtin_clzll((uint64_t)(job->keys[i] ^ job->keys[i - 1]))) / 3;
}

static ast_status octree_count_cells_task(int64_t chunk, void *context) {
  const octree_cells_job *job = context;
  octree_chunk count = {.next = {0}};
  int64_t b = scene_at(job->offsets, job->B, chunk * OCTREE_CHUNK);
  for (int64_t i = chunk * OCTREE_CHUNK; i < min64(job->C, (chunk + 1) * OCTREE_CHUNK); i++) {
    while (job->offsets[b + 1] <= i) b++;
    count.next[octree_starts(job, i, b)]++;
  }
  job->chunks[chunk] = count;
  return AST_OK;
}

static ast_status octree_write_cells_task(int64_t chunk, void *context) {
  const octree_cells_job *job = context;
  octree_chunk own = job->chunks[chunk];
  int64_t begin[OCTREE_LEVELS], *families[OCTREE_LEVELS], b = scene_at(job->offsets, job->B, chunk * OCTREE_CHUNK);
  memcpy(begin, own.next, sizeof begin);
  for (int j = 1; j <= job->root; j++) families[j] = job->level[j].families;
  for (int64_t i = chunk * OCTREE_CHUNK; i < min64(job->C, (chunk + 1) * OCTREE_CHUNK); i++) {
    while (job->offsets[b + 1] <= i) b++;
    const int starts = octree_starts(job, i, b);
    int64_t key = job->keys[i], child = i;
    for (int j = 1; j <= starts; j++) {
      const int64_t P = own.next[j]++;
      families[j][P] = child << 8 | 1 << (key & 7);
      key >>= 3;
      if (j <= job->levels) job->level[j].keys[P] = key;
      child = P;
    }
    if (starts == job->root) continue;
    const int64_t parent = own.next[starts + 1] - 1;
    if (parent >= begin[starts + 1]) families[starts + 1][parent] |= 1 << (key & 7);
    else own.before[starts + 1] |= (uint8_t)(1 << (key & 7));
  }
  memcpy(job->chunks[chunk].before, own.before, sizeof own.before);
  return AST_OK;
}

/* The level whose cells all have key 0, but at least `levels`. */
static int octree_root(const int64_t *keys, const int64_t *offsets, int64_t B, int levels) {
  int root = levels;
  for (int64_t b = 0; b < B; b++)
    while (offsets[b] < offsets[b + 1] && root < 21 && keys[offsets[b + 1] - 1] >> 3 * root) root++;
  return root;
}

/* Turns the counts of the chunks into places: a cell with q starts cells of the levels 1..q. C[j] becomes the cells of
 * level j. */
static void octree_places(octree_chunk *chunks, int64_t num, int root, int64_t C[OCTREE_LEVELS]) {
  memset(C, 0, OCTREE_LEVELS * sizeof *C);
  for (int64_t chunk = 0; chunk < num; chunk++) {
    int64_t starts = 0;
    for (int j = root; j > 0; j--) {
      starts += chunks[chunk].next[j];
      chunks[chunk].next[j] = C[j];
      C[j] += starts;
    }
  }
}

/* The first cell of each scene: of the cells above the cells of the finer level. */
static void octree_scene_offsets(const ast_octree_level *level, const int64_t *fine_offsets) {
  for (int64_t b = 0, cell = 0; b <= level->B; b++)
    level->offsets[b] = cell = lower_bound(level->families, cell, level->C, fine_offsets[b] << 8);
}

/* ---- neighbours ---- */

typedef int64_t octree_families __attribute__((vector_size(64)));
typedef int32_t octree_cells __attribute__((vector_size(32), aligned(4), may_alias));
typedef uint8_t octree_bytes __attribute__((vector_size(8)));

/* How each octant moves by -d, for all d: byte d of a word, item d of a vector. */
typedef struct {
  uint64_t keep[8], copies[8]; /* (families & keep) * copies: byte d & ~octant comes to byte d */
  uint64_t at[8], below[8];    /* bit octant ^ d, and all bits below it */
  octree_cells from[8];        /* d & ~octant */
} octree_moves;

static octree_moves octree_all_moves(void) {
  octree_moves m = {.keep = {0}};
  for (int octant = 0; octant < 8; octant++)
    for (int d = 0; d < 8; d++) {
      if (!(d & octant)) m.keep[octant] |= 255ull << 8 * d;
      if (!(d & ~octant)) m.copies[octant] |= 1ull << 8 * d;
      m.at[octant] |= 1ull << (8 * d + (octant ^ d));
      m.below[octant] |= ((1ull << (octant ^ d)) - 1) << 8 * d;
      m.from[octant][d] = d & ~octant;
    }
  return m;
}

/* The number of bits in each byte. */
AST_INLINE uint64_t octree_bits_of_bytes(uint64_t x) {
  x -= x >> 1 & 0x5555555555555555;
  x = (x & 0x3333333333333333) + (x >> 2 & 0x3333333333333333);
  return (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0f;
}

/* The octants of the children, 0 if there are none, and the first child: of a cell (byte and item 0) and of the cells
 * before it (d). */
AST_INLINE uint64_t octree_families_of(const ast_octree_level *level, int64_t P, octree_cells *first) {
  octree_families families = {level->families[P]};
  if (level->near[P])
    for (int d = 1; d < 8; d++) families[d] = level->families[level->before[P][d]];
  *first = __builtin_convertvector(families >> 8, octree_cells);
  return (uint64_t)__builtin_convertvector(families, octree_bytes);
}

/* Places 8d + octant of the pairs of a coarse cell with the children of the cells before it: d is not 0, and the octant
 * has its bits. */
static const uint64_t octree_pair_places = 0x80c0a0f088ccaa00;

/* The kernel offset of a pair (pairs.c) at place 8d + octant. */
AST_INLINE int octree_group(int place) {
  const int octant = place & 7, d = place >> 3;
  return 9 * ((octant >> 2) - 2 * (d >> 2) + 1) + 3 * ((octant >> 1 & 1) - 2 * (d >> 1 & 1) + 1) + (octant & 1) -
         2 * (d & 1) + 1;
}

typedef struct {
  const ast_octree_level *level,
      *finer; /* the neighbours at `finer` follow from those at `level`; NULL: no need of them */
  const octree_moves *moves;
} octree_neighbour_job;

/* x[from[i]] in lane i */
#ifdef __clang__
AST_INLINE octree_cells octree_pick(octree_cells x, octree_cells from) {
  octree_cells y;
  for (int i = 0; i < 8; i++) y[i] = x[from[i]];
  return y;
}
#else
#define octree_pick(x, from) __builtin_shuffle(x, from)
#endif

/* The cells before child f of P, whose octant this is. */
AST_INLINE void octree_settle(const octree_neighbour_job *job, uint64_t families, octree_cells first, int octant,
                              int64_t f) {
  const octree_moves *m = job->moves;
  const uint64_t moved = (families & m->keep[octant]) * m->copies[octant], found = moved & m->at[octant];
  const octree_bytes earlier = (octree_bytes)octree_bits_of_bytes(moved & m->below[octant]);
  const octree_cells cells = octree_pick(first, m->from[octant]) + __builtin_convertvector(earlier, octree_cells);
  const octree_cells none = __builtin_convertvector((octree_bytes)found, octree_cells) == 0;
  *(octree_cells *)job->finer->before[f] = cells | none;
  job->finer->near[f] = found >> 8 != 0;
}

/* Counts the pairs of a chunk by place, if `count`, and finds the cells before its children, if `settle`. */
AST_INLINE void octree_neighbours(const octree_neighbour_job *job, int64_t chunk, int64_t places[64], const bool count,
                                  const bool settle) {
  const ast_octree_level *level = job->level;
  for (int64_t P = chunk * OCTREE_CHUNK; P < min64(level->C, (chunk + 1) * OCTREE_CHUNK); P++) {
    unsigned octants = octree_octants(level->families[P]);
    int64_t f = octree_first(level->families[P]);
    if (!level->near[P] && !(octants & (octants - 1))) {
      if (count) places[__builtin_ctz(octants)]++;
      if (count) level->others[P] = 0;
      if (settle) job->finer->near[f] = 0;
      continue;
    }
    octree_cells first;
    const uint64_t families = octree_families_of(level, P, &first);
    for (; octants; octants &= octants - 1, f++) {
      if (count) places[__builtin_ctz(octants)]++;
      if (settle) octree_settle(job, families, first, __builtin_ctz(octants), f);
    }
    if (!count) continue;
    uint64_t others = level->others[P] = families & octree_pair_places;
    for (; others; others &= others - 1) places[__builtin_ctzll(others)]++;
  }
}

static ast_status octree_neighbour_task(int64_t chunk, void *context) {
  const octree_neighbour_job *job = context;
  int64_t places[64] = {0}, *pairs = job->level->pairs;
  if (!pairs) octree_neighbours(job, chunk, places, false, true);
  else if (job->finer) octree_neighbours(job, chunk, places, true, true);
  else octree_neighbours(job, chunk, places, true, false);
  for (int place = 0; pairs && place < 64; place++)
    if ((octree_pair_places | 255) >> place & 1) pairs[OCTREE_GROUPS * chunk + octree_group(place)] = places[place];
  return AST_OK;
}

/* ---- all levels ---- */

static int64_t octree_level_bytes(int64_t C, int64_t B) { return 8 * (3 * C + B + 3) + 32 * C + round_up(C, 8); }

/* Takes room for C cells out of `memory`; returns what is left. */
static char *octree_place_level(ast_octree_level *level, int64_t C, int64_t B, int64_t C_fine, char *memory) {
  *level = (ast_octree_level){.C = C, .C_fine = C_fine, .B = B, .keys = (int64_t *)memory};
  level->offsets = level->keys + C;
  level->families = level->offsets + B + 2;
  level->families[-1] = 0; /* of the cell that is not there */
  level->families[C] = C_fine << 8;
  level->others = (uint64_t *)(level->families + C + 1);
  level->before = (int32_t (*)[8])(level->others + C);
  level->near = (uint8_t *)(level->before + C);
  return memory + octree_level_bytes(C, B);
}

/* The cells of all levels up to the root, of which `level` gets all, [root + 1]. */
static ast_status octree_all_cells(octree_cells_job *job, ast_octree_level *level) {
  const int64_t chunks = octree_chunks(job->C);
  if (job->C > INT32_MAX) return AST_TOO_LARGE; /* neighbours are held as int32 */
  job->chunks = ast_scratch(chunks * (int64_t)sizeof *job->chunks);
  if (!job->chunks) return AST_NO_MEMORY;
  ast_parallel(chunks, octree_count_cells_task, job);
  int64_t C[OCTREE_LEVELS], bytes = 0;
  octree_places(job->chunks, chunks, job->root, C);
  for (int j = 1; j <= job->root; j++) bytes += octree_level_bytes(C[j], job->B);
  char *memory = ast_scratch(bytes);
  if (!memory) return AST_NO_MEMORY;
  C[0] = job->C;
  for (int j = 1; j <= job->root; j++) memory = octree_place_level(&level[j], C[j], job->B, C[j - 1], memory);
  ast_parallel(chunks, octree_write_cells_task, job);
  for (int64_t chunk = 1; chunk < chunks; chunk++)
    for (int j = 1; j <= job->root; j++)
      if (job->chunks[chunk].before[j])
        level[j].families[job->chunks[chunk].next[j] - 1] |= job->chunks[chunk].before[j];
  for (int j = 1; j <= job->levels; j++) octree_scene_offsets(&level[j], j == 1 ? job->offsets : level[j - 1].offsets);
  return AST_OK;
}

/* The place of each chunk's pairs in each group, from their numbers, and the offsets of the groups. */
static void octree_pair_offsets(ast_octree_level *level) {
  level->pair_offsets[0] = 0;
  for (int k = 0; k < OCTREE_GROUPS; k++) {
    int64_t next = level->pair_offsets[k];
    for (int64_t chunk = 0; chunk < octree_chunks(level->C); chunk++) {
      const int64_t here = level->pairs[OCTREE_GROUPS * chunk + k];
      level->pairs[OCTREE_GROUPS * chunk + k] = next;
      next += here;
    }
    level->pair_offsets[k + 1] = next;
  }
}

static ast_status octree_coarsen(const int64_t *restrict keys, const int64_t *restrict offsets, int64_t B, int levels,
                                 ast_octree_level *restrict coarser) {
  ast_octree_level level[OCTREE_LEVELS];
  if (levels == 0) return AST_OK;
  octree_cells_job cells = {keys, offsets, B, offsets[B], octree_root(keys, offsets, B, levels), levels, NULL, level};
  const ast_status status = octree_all_cells(&cells, level);
  if (status != AST_OK) return status;
  int64_t counts = 0;
  for (int j = 1; j <= levels; j++) counts += OCTREE_GROUPS * octree_chunks(level[j].C);
  int64_t *memory = ast_scratch(counts * (int64_t)sizeof *memory);
  if (!memory) return AST_NO_MEMORY;
  for (int j = 1; j <= levels; memory += OCTREE_GROUPS * octree_chunks(level[j++].C)) level[j].pairs = memory;
  memset(level[cells.root].near, 0, (size_t)level[cells.root].C);
  const octree_moves moves = octree_all_moves();
  for (int j = cells.root; j > 0; j--) {
    octree_neighbour_job neighbour = {&level[j], j > 1 ? &level[j - 1] : NULL, &moves};
    ast_parallel(octree_chunks(level[j].C), octree_neighbour_task, &neighbour);
    if (j <= levels) octree_pair_offsets(&level[j]);
  }
  memcpy(coarser, level + 1, (size_t)levels * sizeof *coarser);
  return AST_OK;
}
