/* Farthest point sampling of one scene, included by fps.c once per type T of coordinates and squared distances, which are exact in T;
 * INTEGER is the integer of its size, FPS(name) makes the names of that type. Blocks come in groups of FPS_LANES, a whole number of vectors
 * of T. */

typedef T FPS(vector) __attribute__((vector_size(AST_VECTOR_BYTES), aligned(sizeof(T)), may_alias));
typedef INTEGER FPS(mask) __attribute__((vector_size(AST_VECTOR_BYTES))); /* of a comparison: -1 is true */
enum { FPS(width) = AST_VECTOR_BYTES / sizeof(T), FPS(parts) = FPS_LANES / FPS(width) };

AST_INLINE FPS(vector) FPS(select)(FPS(mask) mask, FPS(vector) a, FPS(vector) b) {
  return (FPS(vector))(((FPS(mask))a & mask) | ((FPS(mask))b & ~mask));
}
AST_INLINE FPS(vector) FPS(max)(FPS(vector) a, FPS(vector) b) { return FPS(select)(a > b, a, b); }
AST_INLINE FPS(vector) FPS(min)(FPS(vector) a, FPS(vector) b) { return FPS(select)(a < b, a, b); }
AST_INLINE FPS(vector) FPS(load)(const T *p) { return *(const FPS(vector) *)p; }
AST_INLINE void FPS(store)(T *p, FPS(vector) x) { *(FPS(vector) *)p = x; }

/* Points in blocks of consecutive ones, padded with copies of the last point, which comes first of them; the number of blocks is padded
 * to whole groups with empty ones of distance 0, which are never farthest. */
typedef struct {
  int64_t size, groups;   /* points of a block, a multiple of FPS_LANES; groups of blocks */
  T *point[3], *distance; /* of each point, from the samples so far */
  T *low[3], *high[3];    /* of each block: its bounding box */
  T *farthest;            /* of each block: its largest distance */
} FPS(blocks);

static int64_t FPS(bytes)(int64_t n, int64_t size) {
  const int64_t blocks = round_up((n + size - 1) / size, FPS_LANES);
  return blocks * (4 * size + 7) * (int64_t)sizeof(T);
}

/* The points of block b, relative to the origin, and its bounding box. */
static void FPS(fill)(const FPS(blocks) * s, const int32_t *coordinates, int64_t n, const int32_t origin[3], int64_t b) {
  const int64_t begin = b * s->size, points = n - begin < s->size ? n - begin : s->size;
  const int32_t *in = coordinates + 3 * begin;
  for (int a = 0; a < 3; a++) {
    T *restrict point = s->point[a] + begin;
    for (int64_t i = 0; i < points; i++) point[i] = (T)(in[3 * i + a] - origin[a]);
    for (int64_t i = points; i < s->size; i++) point[i] = point[points - 1];
    FPS(vector) low = FPS(load)(point), high = low;
    for (int64_t i = FPS(width); i < s->size; i += FPS(width)) {
      low = FPS(min)(low, FPS(load)(point + i));
      high = FPS(max)(high, FPS(load)(point + i));
    }
    s->low[a][b] = low[0];
    s->high[a][b] = high[0];
    for (int l = 1; l < FPS(width); l++) {
      s->low[a][b] = low[l] < s->low[a][b] ? low[l] : s->low[a][b];
      s->high[a][b] = high[l] > s->high[a][b] ? high[l] : s->high[a][b];
    }
  }
  for (int64_t i = 0; i < s->size; i++) s->distance[begin + i] = FPS_FAR;
  s->farthest[b] = FPS_FAR;
}

static FPS(blocks) FPS(cut)(const int32_t *coordinates, int64_t n, const int32_t origin[3], int64_t size, void *memory) {
  const int64_t used = (n + size - 1) / size, blocks = round_up(used, FPS_LANES), points = blocks * size;
  T *next = memory;
  FPS(blocks) s = {.size = size, .groups = blocks / FPS_LANES, .distance = next, .farthest = next + points};
  next += points + blocks;
  for (int a = 0; a < 3; a++, next += points + 2 * blocks) {
    s.point[a] = next;
    s.low[a] = next + points;
    s.high[a] = next + points + blocks;
  }
  for (int64_t b = 0; b < used; b++) FPS(fill)(&s, coordinates, n, origin, b);
  for (int64_t b = used; b < blocks; b++) {
    for (int a = 0; a < 3; a++) s.low[a][b] = s.high[a][b] = 0;
    s.farthest[b] = 0;
  }
  return s;
}

/* Brings the distances of block b up to date with the sample at p; returns the largest. */
AST_INLINE T FPS(rescan)(const FPS(blocks) * s, int64_t b, T px, T py, T pz) {
  const T *x = s->point[0] + b * s->size, *y = s->point[1] + b * s->size, *z = s->point[2] + b * s->size;
  T *distance = s->distance + b * s->size;
  FPS(vector) farthest = {0};
  for (int64_t i = 0; i < s->size; i += FPS(width)) {
    const FPS(vector) dx = FPS(load)(x + i) - px, dy = FPS(load)(y + i) - py, dz = FPS(load)(z + i) - pz;
    const FPS(vector) least = FPS(min)(FPS(load)(distance + i), dx * dx + dy * dy + dz * dz);
    FPS(store)(distance + i, least);
    farthest = FPS(max)(farthest, least);
  }
  T result = 0;
  for (int l = 0; l < FPS(width); l++) result = farthest[l] > result ? farthest[l] : result;
  return result;
}

/* Lists the blocks of group g that may hold a point nearer to p than to the samples so far: those whose box is nearer than their
 * farthest point. All others keep every distance. */
AST_INLINE int FPS(reach)(const FPS(blocks) * s, int64_t g, T px, T py, T pz, int32_t list[FPS_LANES]) {
  FPS(mask) reached[FPS(parts)], any = {0};
#pragma GCC unroll 8
  for (int v = 0; v < FPS(parts); v++) {
    const int64_t b = g * FPS_LANES + v * FPS(width);
    const FPS(vector) zero = {0};
    const FPS(vector) dx = FPS(max)(FPS(max)(FPS(load)(s->low[0] + b) - px, px - FPS(load)(s->high[0] + b)), zero);
    const FPS(vector) dy = FPS(max)(FPS(max)(FPS(load)(s->low[1] + b) - py, py - FPS(load)(s->high[1] + b)), zero);
    const FPS(vector) dz = FPS(max)(FPS(max)(FPS(load)(s->low[2] + b) - pz, pz - FPS(load)(s->high[2] + b)), zero);
    reached[v] = dx * dx + dy * dy + dz * dz < FPS(load)(s->farthest + b);
    any |= reached[v];
  }
  uint64_t word[AST_VECTOR_BYTES / 8], all = 0;
  memcpy(word, &any, sizeof any);
  for (int i = 0; i < AST_VECTOR_BYTES / 8; i++) all |= word[i];
  if (!all) return 0;
  int num = 0;
  for (int v = 0; v < FPS(parts); v++)
    for (int l = 0; l < FPS(width); l++) {
      list[num] = v * FPS(width) + l;
      num -= (int)reached[v][l]; /* true is -1 */
    }
  return num;
}

/* Adds point `pick` to the samples. Returns the point that is now farthest from them, the first of several, or -1 if all distances
 * are 0. */
static int64_t FPS(step)(const FPS(blocks) * s, int64_t pick) {
  const T px = s->point[0][pick], py = s->point[1][pick], pz = s->point[2][pick];
  FPS(vector) best[FPS(parts)] = {0}, group[FPS(parts)] = {0};
  int32_t list[FPS_LANES];
  for (int64_t g = 0; g < s->groups; g++) {
    T *farthest = s->farthest + g * FPS_LANES;
    const int num = FPS(reach)(s, g, px, py, pz, list);
    for (int i = 0; i < num; i++) farthest[list[i]] = FPS(rescan)(s, g * FPS_LANES + list[i], px, py, pz);
#pragma GCC unroll 8
    for (int v = 0; v < FPS(parts); v++) {
      const FPS(vector) here = FPS(load)(farthest + v * FPS(width));
      group[v] = FPS(select)(here > best[v], (FPS(vector)){0} + (T)g, group[v]);
      best[v] = FPS(max)(best[v], here);
    }
  }
  T value = 0;
  int64_t block = 0;
  for (int v = 0; v < FPS(parts); v++)
    for (int l = 0; l < FPS(width); l++) {
      const int64_t b = (int64_t)group[v][l] * FPS_LANES + v * FPS(width) + l;
      if (best[v][l] > value || (best[v][l] == value && b < block)) block = b;
      if (best[v][l] > value) value = best[v][l];
    }
  if (!(value > 0)) return -1;
  for (pick = block * s->size; s->distance[pick] < value;) pick++;
  return pick;
}

#undef T
#undef INTEGER
#undef FPS
#undef FPS_FAR
