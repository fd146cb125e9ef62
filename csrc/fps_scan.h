/* Farthest point sampling of one scene, included by fps.c once per type T of coordinates and squared distances, which are exact in T:
 * FPS(name) makes the names of that type. All inner loops run over FPS_LANES items, so that they become vectors. */

/* Points in blocks of consecutive ones, padded with points of distance -1, which no distance is below; the number of blocks is
 * padded with empty ones to whole groups of FPS_LANES. */
typedef struct {
  int64_t size, groups;   /* points of a block; groups of blocks */
  T *point[3], *distance; /* of each point, from the samples so far */
  T *low[3], *high[3];    /* of each block: its bounding box */
  T *farthest;            /* of each block: its largest distance */
} FPS(blocks);

static int64_t FPS(bytes)(int64_t n, int64_t size) {
  const int64_t blocks = round_up((n + size - 1) / size, FPS_LANES);
  return blocks * (4 * size + 7) * (int64_t)sizeof(T);
}

static FPS(blocks) FPS(cut)(const int32_t *coordinates, int64_t n, const int32_t origin[3], int64_t size, void *memory) {
  const int64_t blocks = round_up((n + size - 1) / size, FPS_LANES), points = blocks * size;
  T *next = memory;
  FPS(blocks) s = {.size = size, .groups = blocks / FPS_LANES, .distance = next, .farthest = next + points};
  next += points + blocks;
  for (int a = 0; a < 3; a++, next += points + 2 * blocks) {
    T *const point = s.point[a] = next, *const low = s.low[a] = next + points, *const high = s.high[a] = next + points + blocks;
    for (int64_t i = 0; i < n; i++) point[i] = (T)(coordinates[3 * i + a] - origin[a]);
    for (int64_t i = n; i < points; i++) point[i] = point[n - 1];
    for (int64_t b = 0; b < blocks; b++) {
      low[b] = high[b] = point[b * size];
      for (int64_t i = b * size; i < (b + 1) * size; i++) {
        low[b] = point[i] < low[b] ? point[i] : low[b];
        high[b] = point[i] > high[b] ? point[i] : high[b];
      }
    }
  }
  for (int64_t i = 0; i < points; i++) s.distance[i] = i < n ? FPS_FAR : -1;
  for (int64_t b = 0; b < blocks; b++) s.farthest[b] = b * size < n ? FPS_FAR : -1;
  return s;
}

/* Brings the distances of block b up to date with the sample at p; returns the largest. */
static T FPS(rescan)(const FPS(blocks) * s, int64_t b, T px, T py, T pz) {
  const T *restrict x = s->point[0] + b * s->size, *restrict y = s->point[1] + b * s->size, *restrict z = s->point[2] + b * s->size;
  T *restrict distance = s->distance + b * s->size, farthest[FPS_LANES], result = -1;
  for (int l = 0; l < FPS_LANES; l++) farthest[l] = -1;
  for (int64_t i = 0; i < s->size; i += FPS_LANES)
    for (int l = 0; l < FPS_LANES; l++) {
      const T dx = x[i + l] - px, dy = y[i + l] - py, dz = z[i + l] - pz, d = dx * dx + dy * dy + dz * dz;
      const T least = d < distance[i + l] ? d : distance[i + l];
      distance[i + l] = least;
      farthest[l] = least > farthest[l] ? least : farthest[l];
    }
  for (int l = 0; l < FPS_LANES; l++) result = farthest[l] > result ? farthest[l] : result;
  return result;
}

/* Which blocks of group g hold a point that may be nearer to p than to the samples so far: those whose box is nearer than their
 * farthest point. All others keep every distance. */
AST_INLINE bool FPS(reach)(const FPS(blocks) * s, int64_t g, T px, T py, T pz, T reached[FPS_LANES]) {
  const T *restrict lx = s->low[0] + g * FPS_LANES, *restrict ly = s->low[1] + g * FPS_LANES, *restrict lz = s->low[2] + g * FPS_LANES;
  const T *restrict hx = s->high[0] + g * FPS_LANES, *restrict hy = s->high[1] + g * FPS_LANES, *restrict hz = s->high[2] + g * FPS_LANES;
  const T *restrict farthest = s->farthest + g * FPS_LANES;
  T any = 0;
  for (int l = 0; l < FPS_LANES; l++) {
    T dx = lx[l] - px > px - hx[l] ? lx[l] - px : px - hx[l], dy = ly[l] - py > py - hy[l] ? ly[l] - py : py - hy[l],
      dz = lz[l] - pz > pz - hz[l] ? lz[l] - pz : pz - hz[l];
    dx = dx > 0 ? dx : 0;
    dy = dy > 0 ? dy : 0;
    dz = dz > 0 ? dz : 0;
    reached[l] = dx * dx + dy * dy + dz * dz < farthest[l] ? 1 : 0;
  }
  for (int l = 0; l < FPS_LANES; l++) any += reached[l];
  return any > 0;
}

/* Adds point `pick` to the samples. Returns the point that is now farthest from them, the first of several, or -1 if all distances
 * are 0. */
static int64_t FPS(step)(const FPS(blocks) * s, int64_t pick) {
  const T px = s->point[0][pick], py = s->point[1][pick], pz = s->point[2][pick];
  T best[FPS_LANES] = {0}, group[FPS_LANES] = {0}, reached[FPS_LANES], value = 0;
  int64_t block = 0;
  for (int64_t g = 0; g < s->groups; g++) {
    T *restrict farthest = s->farthest + g * FPS_LANES;
    if (FPS(reach)(s, g, px, py, pz, reached))
      for (int l = 0; l < FPS_LANES; l++)
        if (reached[l] > 0) farthest[l] = FPS(rescan)(s, g * FPS_LANES + l, px, py, pz);
    for (int l = 0; l < FPS_LANES; l++) {
      group[l] = farthest[l] > best[l] ? (T)g : group[l];
      best[l] = farthest[l] > best[l] ? farthest[l] : best[l];
    }
  }
  for (int l = 0; l < FPS_LANES; l++) {
    const int64_t b = (int64_t)group[l] * FPS_LANES + l;
    if (best[l] > value || (best[l] == value && b < block)) block = b;
    if (best[l] > value) value = best[l];
  }
  if (!(value > 0)) return -1;
  for (pick = block * s->size; s->distance[pick] < value;) pick++;
  return pick;
}

#undef T
#undef FPS
#undef FPS_FAR
