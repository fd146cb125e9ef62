/* Farthest point sampling of one scene, included by fps.c once per type T of squared distances and type COORDINATE of
 * coordinates relative to the middle of the scene; FPS(name) makes the names of that type. The loops over points are
 * written for the compiler to vectorise. */

/* Points in blocks of consecutive ones. Copies of the last point pad the last block; it comes before them. */
typedef struct {
  int64_t size, blocks;   /* points of a block, a multiple of FPS_TILE */
  int64_t *seen;          /* [blocks] the number of samples that the block has seen */
  T *distances;           /* [blocks,size] from these */
  COORDINATE *points;     /* [blocks,3,size] */
  COORDINATE *boxes;      /* [blocks,6]: lowest x, y, z, highest x, y, z */
  COORDINATE *samples[3]; /* x, y, z of all samples so far, then FPS_TILE items that are read but do not matter */
  fps_tournament tournament;
} FPS(scene);

/* Room for the blocks and the samples of a scene; no points in it yet. */
static bool FPS(reserve)(FPS(scene) * scene, int64_t n, int64_t num, int64_t size) {
  const int64_t blocks = divide_up(n, size), samples = num + FPS_TILE;
  int64_t leaves = 1;
  while (leaves < blocks) leaves *= 2;
  const int64_t large = 2 * leaves + blocks, middle = blocks * size, small = blocks * (3 * size + 6) + 3 * samples;
  int64_t *memory = ast_scratch(large * 8 + middle * (int64_t)sizeof(T) + small * (int64_t)sizeof(COORDINATE));
  if (!memory) return false;
  *scene = (FPS(scene)){.size = size, .blocks = blocks, .seen = memory + 2 * leaves, .tournament = {leaves, memory}};
  scene->distances = (T *)(memory + large);
  scene->points = (COORDINATE *)(scene->distances + middle);
  scene->boxes = scene->points + 3 * blocks * size;
  for (int a = 0; a < 3; a++) scene->samples[a] = scene->boxes + 6 * blocks + a * samples;
  memset(scene->samples[0], 0, 3 * (size_t)samples * sizeof(COORDINATE));
  return true;
}

AST_INLINE T FPS(square)(int32_t x, int32_t y, int32_t z) { return (T)x * x + (T)y * y + (T)z * z; }

/* Brings the distances of block b up to date with `num` samples; returns the largest. */
AST_INLINE T FPS(pass)(const FPS(scene) * scene, int64_t b, const int64_t *list, const int num) {
  const int64_t size = scene->size;
  const COORDINATE *restrict x = scene->points + 3 * size * b, *restrict y = x + size, *restrict z = y + size;
  T *restrict distances = scene->distances + size * b, farthest = 0;
  COORDINATE p[4], q[4], r[4];
  for (int k = 0; k < num; k++)
    p[k] = scene->samples[0][list[k]], q[k] = scene->samples[1][list[k]], r[k] = scene->samples[2][list[k]];
  for (int64_t i = 0; i < size; i++) {
    T least = distances[i];
#pragma GCC unroll 4
    for (int k = 0; k < num; k++) {
      const T square = FPS(square)(x[i] - p[k], y[i] - q[k], z[i] - r[k]);
      least = square < least ? square : least;
    }
    distances[i] = least;
    farthest = least > farthest ? least : farthest;
  }
  return farthest;
}

/* ... with all of a list, at least one, several in a pass. */
static T FPS(scan)(const FPS(scene) * scene, int64_t b, const int64_t *list, int num) {
  for (; num > 4; num -= 4, list += 4) FPS(pass)(scene, b, list, 4);
  switch (num) {
    case 1:
      return FPS(pass)(scene, b, list, 1);
    case 2:
      return FPS(pass)(scene, b, list, 2);
    case 3:
      return FPS(pass)(scene, b, list, 3);
    default:
      return FPS(pass)(scene, b, list, 4);
  }
}

/* Which of the samples i..i+31 are nearer to the box than `bound`, as bits. */
AST_INLINE uint32_t FPS(near)(const FPS(scene) * scene, const COORDINATE *box, T bound, int64_t i) {
  const COORDINATE *x = scene->samples[0] + i, *y = scene->samples[1] + i, *z = scene->samples[2] + i;
  uint32_t bits = 0;
  for (int l = 0; l < 32; l++) {
    int32_t d[3] = {x[l], y[l], z[l]};
    EACH(3, a) {
      const int32_t below = box[a] - d[a], above = d[a] - box[3 + a], outside = below > above ? below : above;
      d[a] = outside > 0 ? outside : 0;
    }
    bits |= FPS(square)(d[0], d[1], d[2]) < bound ? fps_bits[l] : 0;
  }
  return bits;
}

/* Shows block b the new ones of the first `taken` samples; `bound` is its bound; returns the new bound. */
static T FPS(update)(const FPS(scene) * scene, int64_t b, T bound, int64_t taken) {
  const COORDINATE *box = scene->boxes + 6 * b;
  int64_t list[128];
  int num = 0;
  for (int64_t i = scene->seen[b]; i < taken; i += 64) {
    uint64_t bits = FPS(near)(scene, box, bound, i);
    if (taken - i > 32) bits |= (uint64_t)FPS(near)(scene, box, bound, i + 32) << 32;
    if (taken - i < 64) bits &= (1ull << (taken - i)) - 1;
    while (bits) {
      const int l = __builtin_ctzll(bits);
      list[num++] = i + l;
      bits ^= 1ull << l;
    }
    if (num == 0 || (num < 64 && i + 64 < taken)) continue;
    bound = FPS(scan)(scene, b, list, num);
    num = 0;
  }
  scene->seen[b] = taken;
  return bound;
}

/* The points of block b, its bounding box, and the distances from the first sample; returns the largest. */
static T FPS(fill)(const FPS(scene) * scene, const int32_t *coordinates, int64_t n, const int32_t origin[3],
                   int64_t b) {
  const int64_t size = scene->size, begin = b * size, points = min64(n - begin, size);
  const int32_t *restrict in = coordinates + 3 * begin;
  COORDINATE *restrict x = scene->points + 3 * size * b, *restrict y = x + size, *restrict z = y + size;
  for (int64_t i = 0; i < points; i++) {
    x[i] = (COORDINATE)(in[3 * i] - origin[0]);
    y[i] = (COORDINATE)(in[3 * i + 1] - origin[1]);
    z[i] = (COORDINATE)(in[3 * i + 2] - origin[2]);
  }
  for (int64_t i = points; i < size; i++) x[i] = x[points - 1], y[i] = y[points - 1], z[i] = z[points - 1];
  for (int a = 0; a < 3; a++) {
    const COORDINATE *p = x + a * size;
    COORDINATE low = p[0], high = p[0];
    for (int64_t i = 0; i < size; i++) {
      low = p[i] < low ? p[i] : low;
      high = p[i] > high ? p[i] : high;
    }
    scene->boxes[6 * b + a] = low;
    scene->boxes[6 * b + 3 + a] = high;
  }
  const COORDINATE px = scene->samples[0][0], py = scene->samples[1][0], pz = scene->samples[2][0];
  T *restrict distances = scene->distances + begin, farthest = 0;
  for (int64_t i = 0; i < size; i++) {
    distances[i] = FPS(square)(x[i] - px, y[i] - py, z[i] - pz);
    farthest = distances[i] > farthest ? distances[i] : farthest;
  }
  scene->seen[b] = 1;
  return farthest;
}

/* The first point of block b at this distance, counted within the block. */
static int64_t FPS(find)(const FPS(scene) * scene, int64_t b, T distance) {
  const T *distances = scene->distances + scene->size * b, size = (T)scene->size;
  T first = size;
  for (T i = 0; i < size; i++) {
    const T here = distances[i] == distance ? i : size;
    first = here < first ? here : first;
  }
  return first;
}

/* Writes the indices of the samples, from `begin` on, until there are num or all distances are 0. Returns their number,
 * 0 without memory. */
static int64_t FPS(sample)(const int32_t *coordinates, int64_t n, const int32_t origin[3], int64_t begin, int64_t num,
                           int64_t *indices) {
  FPS(scene) scene;
  if (!FPS(reserve)(&scene, n, num, fps_block_size(n))) return 0;
  const fps_tournament t = scene.tournament;
  for (int a = 0; a < 3; a++) scene.samples[a][0] = (COORDINATE)(coordinates[a] - origin[a]);
  for (int64_t b = 0; b < t.leaves; b++)
    t.keys[t.leaves + b] = b < scene.blocks ? fps_key(FPS(fill)(&scene, coordinates, n, origin, b), b) : -1;
  for (int64_t i = t.leaves - 1; i > 0; i--) t.keys[i] = max64(t.keys[2 * i], t.keys[2 * i + 1]);
  indices[0] = begin;
  int64_t taken = 1;
  while (taken < num) {
    const int64_t b = fps_key_block(t.keys[1]);
    T bound = (T)fps_key_bound(t.keys[1]);
    if (bound == 0) break;
    if (scene.seen[b] < taken) {
      bound = FPS(update)(&scene, b, bound, taken);
    } else { /* it has seen all samples: the next one is here, and the block sees it at once */
      const int64_t added = taken;
      const int64_t i = FPS(find)(&scene, b, bound);
      for (int a = 0; a < 3; a++) scene.samples[a][taken] = scene.points[(3 * b + a) * scene.size + i];
      indices[taken++] = begin + b * scene.size + i;
      scene.seen[b] = taken;
      bound = FPS(scan)(&scene, b, &added, 1);
    }
    fps_replay(t, fps_key(bound, b));
  }
  return taken;
}

#undef T
#undef COORDINATE
#undef FPS
