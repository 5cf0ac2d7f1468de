/* Embree behind embree.h: builds against 3.13 and 4.x; what differs between them stands behind RTC_VERSION_MAJOR.
 * build.rs says which header there is (DOME_EMBREE_4 or nothing).
 *
 * Instances have the geometry ids of the caller's instances, so an answer needs no table: a mesh of the world answers
 * with its geomID, an instanced one with its instID. */
#include "embree.h"

#ifdef DOME_EMBREE_4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <math.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

_Static_assert(sizeof(dome_ray) == 32, "dome_ray");
_Static_assert(sizeof(dome_hit) == 20, "dome_hit");
_Static_assert(sizeof(dome_options) == 20, "dome_options");
_Static_assert(sizeof(dome_mesh) == 40, "dome_mesh");
_Static_assert(sizeof(dome_memory) == 16, "dome_memory");
_Static_assert(sizeof(struct RTCRay) == 48, "RTCRay");

struct dome_embree {
  RTCDevice device;
  RTCScene world;
  RTCScene *shared;
  size_t shared_count;
  size_t shared_capacity;
  enum RTCSceneFlags flags;
  enum RTCBuildQuality quality;
  bool single;
  _Atomic int64_t bytes;
  _Atomic int64_t peak_bytes;
  char error[256];
};

/* Keeps the first error: what follows is mostly its consequence. */
static void fail(dome_embree *embree, const char *text) {
  if (embree->error[0] == 0) snprintf(embree->error, sizeof embree->error, "%s", text);
}

/* Called by Embree, also from its build threads; two at once may both write, which only garbles the text. */
static void on_error(void *user, enum RTCError code, const char *text) {
  if (code == RTC_ERROR_OUT_OF_MEMORY) text = "out of memory";
  fail(user, text != NULL && text[0] != 0 ? text : "unknown error");
}

static bool on_memory(void *user, ssize_t bytes, bool post) {
  dome_embree *embree = user;
  (void)post;
  int64_t now = atomic_fetch_add_explicit(&embree->bytes, bytes, memory_order_relaxed) + bytes;
  int64_t peak = atomic_load_explicit(&embree->peak_bytes, memory_order_relaxed);
  while (now > peak && !atomic_compare_exchange_weak_explicit(&embree->peak_bytes, &peak, now, memory_order_relaxed,
                                                              memory_order_relaxed)) {
  }
  return true;
}

static RTCScene new_scene(dome_embree *embree) {
  RTCScene scene = rtcNewScene(embree->device);
  if (scene == NULL) return NULL;
  rtcSetSceneFlags(scene, embree->flags);
  rtcSetSceneBuildQuality(scene, embree->quality);
  return scene;
}

dome_embree *dome_create(const dome_options *options) {
  dome_embree *embree = calloc(1, sizeof *embree);
  if (embree == NULL) return NULL;
  char config[64];
  snprintf(config, sizeof config, "threads=%u", options->threads);
  embree->device = rtcNewDevice(config);
  if (embree->device == NULL) {
    bool memory = rtcGetDeviceError(NULL) == RTC_ERROR_OUT_OF_MEMORY;
    fail(embree, memory ? "out of memory" : "no device: is this processor supported?");
    return embree;
  }
  rtcSetDeviceErrorFunction(embree->device, on_error, embree);
  rtcSetDeviceMemoryMonitorFunction(embree->device, on_memory, embree);

  /* Struct layouts changed between minor versions: the library must be the header's. */
  unsigned version = dome_library_version(embree);
  if (version / 100 != RTC_VERSION / 100) {
    char text[128];
    snprintf(text, sizeof text, "built against Embree %s, but the library is %u.%u: rebuild domelight",
             RTC_VERSION_STRING, version / 10000, version / 100 % 100);
    fail(embree, text);
    return embree;
  }
  int flags = RTC_SCENE_FLAG_NONE;
  if (options->robust) flags |= RTC_SCENE_FLAG_ROBUST;
  if (options->compact) flags |= RTC_SCENE_FLAG_COMPACT;
  embree->flags = (enum RTCSceneFlags)flags;
  static const enum RTCBuildQuality QUALITIES[3] = {RTC_BUILD_QUALITY_LOW, RTC_BUILD_QUALITY_MEDIUM,
                                                    RTC_BUILD_QUALITY_HIGH};
  embree->quality = QUALITIES[options->quality < 3 ? options->quality : 1];
  embree->single = options->single != 0;
  embree->world = new_scene(embree);
  return embree;
}

void dome_destroy(dome_embree *embree) {
  if (embree == NULL) return;
  if (embree->world != NULL) rtcReleaseScene(embree->world);
  for (size_t i = 0; i < embree->shared_count; i++) rtcReleaseScene(embree->shared[i]);
  free(embree->shared);
  if (embree->device != NULL) {
    rtcSetDeviceErrorFunction(embree->device, NULL, NULL);
    rtcReleaseDevice(embree->device);
  }
  free(embree);
}

const char *dome_error(const dome_embree *embree) { return embree->error[0] != 0 ? embree->error : NULL; }

uint32_t dome_library_version(const dome_embree *embree) {
  return (uint32_t)rtcGetDeviceProperty(embree->device, RTC_DEVICE_PROPERTY_VERSION);
}

/* Embree reads past the end of shared vertex buffers: these buffers are its own, and padded by it. */
static int attach_mesh(dome_embree *embree, RTCScene scene, const dome_mesh *mesh, uint32_t id) {
  RTCGeometry geometry = rtcNewGeometry(embree->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  if (geometry == NULL) return 1;
  size_t vertex = 3 * sizeof(float), triangle = 3 * sizeof(uint32_t);
  void *vertices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, vertex,
                                           mesh->vertex_count);
  void *indices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, triangle,
                                          mesh->triangle_count);
  if (vertices != NULL && indices != NULL) {
    memcpy(vertices, mesh->positions, vertex * mesh->vertex_count);
    memcpy(indices, mesh->indices, triangle * mesh->triangle_count);
    rtcSetGeometryBuildQuality(geometry, embree->quality);
    rtcSetGeometryMask(geometry, mesh->mask);
    rtcCommitGeometry(geometry);
    rtcAttachGeometryByID(scene, geometry, id);
  } else {
    fail(embree, "out of memory for a mesh");
  }
  rtcReleaseGeometry(geometry);
  return embree->error[0] != 0;
}

int dome_add_mesh(dome_embree *embree, const dome_mesh *mesh, uint32_t instance) {
  return attach_mesh(embree, embree->world, mesh, instance);
}

int dome_add_shared(dome_embree *embree, const dome_mesh *mesh) {
  if (embree->shared_count == embree->shared_capacity) {
    size_t capacity = embree->shared_capacity ? 2 * embree->shared_capacity : 16;
    RTCScene *grown = realloc(embree->shared, capacity * sizeof(RTCScene));
    if (grown == NULL) return fail(embree, "out of memory for the list of meshes"), 1;
    embree->shared = grown;
    embree->shared_capacity = capacity;
  }
  RTCScene scene = new_scene(embree);
  if (scene == NULL) return 1;
  embree->shared[embree->shared_count++] = scene;
  if (attach_mesh(embree, scene, mesh, 0)) return 1;
  rtcCommitScene(scene);
  return embree->error[0] != 0;
}

int dome_add_instance(dome_embree *embree, uint32_t shared, uint32_t mask, const float transform[12],
                      uint32_t instance) {
  if (shared >= embree->shared_count) return fail(embree, "an instance names no mesh"), 1;
  RTCGeometry geometry = rtcNewGeometry(embree->device, RTC_GEOMETRY_TYPE_INSTANCE);
  if (geometry == NULL) return 1;
  rtcSetGeometryInstancedScene(geometry, embree->shared[shared]);
  rtcSetGeometryTransform(geometry, 0, RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR, transform);
  rtcSetGeometryMask(geometry, mask);
  rtcCommitGeometry(geometry);
  rtcAttachGeometryByID(embree->world, geometry, instance);
  rtcReleaseGeometry(geometry);
  return embree->error[0] != 0;
}

int dome_commit(dome_embree *embree) {
  rtcCommitScene(embree->world);
  return embree->error[0] != 0;
}

dome_memory dome_memory_used(const dome_embree *embree) {
  dome_memory memory = {atomic_load(&embree->bytes), atomic_load(&embree->peak_bytes)};
  return memory;
}

/* ------------------------------------------------------------------------------------------- version differences */

#if RTC_VERSION_MAJOR >= 4
typedef struct RTCIntersectArguments intersect_args;
typedef struct RTCOccludedArguments occluded_args;
static intersect_args make_intersect_args(bool coherent) {
  intersect_args args;
  rtcInitIntersectArguments(&args);
  args.flags = coherent ? RTC_RAY_QUERY_FLAG_COHERENT : RTC_RAY_QUERY_FLAG_INCOHERENT;
  args.feature_mask = (enum RTCFeatureFlags)(RTC_FEATURE_FLAG_TRIANGLE | RTC_FEATURE_FLAG_INSTANCE);
  return args;
}
static occluded_args make_occluded_args(void) {
  occluded_args args;
  rtcInitOccludedArguments(&args);
  args.feature_mask = (enum RTCFeatureFlags)(RTC_FEATURE_FLAG_TRIANGLE | RTC_FEATURE_FLAG_INSTANCE);
  return args;
}
#define INTERSECT1(scene, args, rayhit) rtcIntersect1(scene, rayhit, args)
#define INTERSECT16(valid, scene, args, rayhit) rtcIntersect16(valid, scene, rayhit, args)
#define OCCLUDED1(scene, args, ray) rtcOccluded1(scene, ray, args)
#define OCCLUDED16(valid, scene, args, ray) rtcOccluded16(valid, scene, ray, args)
#else
typedef struct RTCIntersectContext intersect_args;
typedef struct RTCIntersectContext occluded_args;
static intersect_args make_intersect_args(bool coherent) {
  intersect_args context;
  rtcInitIntersectContext(&context);
  context.flags = coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
  return context;
}
static occluded_args make_occluded_args(void) { return make_intersect_args(false); }
#define INTERSECT1(scene, args, rayhit) rtcIntersect1(scene, args, rayhit)
#define INTERSECT16(valid, scene, args, rayhit) rtcIntersect16(valid, scene, args, rayhit)
#define OCCLUDED1(scene, args, ray) rtcOccluded1(scene, args, ray)
#endif

/* ------------------------------------------------------------------------------------------------------ the rays */

typedef float float4 __attribute__((vector_size(16)));

/* In whole vectors, as Embree will read it: a vector load has to wait for scalar stores to leave for the cache. */
static struct RTCRay to_rtc(const dome_ray *ray, uint32_t mask) {
  float4 origin, dir, rest = {ray->tfar};
  const char *from = (const char *)ray;
  memcpy(&origin, from + offsetof(dome_ray, origin), sizeof origin); /* and tnear */
  memcpy(&dir, from + offsetof(dome_ray, dir), sizeof dir);          /* and tfar, where the time has to be 0 */
  dir[3] = 0.0f;
  memcpy((char *)&rest + sizeof(float), &mask, sizeof mask);
  struct RTCRay out;
  char *to = (char *)&out;
  memcpy(to + offsetof(struct RTCRay, org_x), &origin, sizeof origin);
  memcpy(to + offsetof(struct RTCRay, dir_x), &dir, sizeof dir);
  memcpy(to + offsetof(struct RTCRay, tfar), &rest, sizeof rest);
  return out;
}

/* Fills a packet of 16; `lanes` says which of them carry a ray. */
static void to_rtc16(const dome_ray *rays, size_t count, uint32_t mask, struct RTCRay16 *out, int32_t lanes[16]) {
  dome_ray filled[16];
  for (size_t i = 0; i < 16; i++) lanes[i] = i < count ? -1 : 0;
  if (count < 16) {
    for (size_t i = 0; i < 16; i++) filled[i] = rays[i < count ? i : 0];
    rays = filled;
  }
  for (size_t i = 0; i < 16; i++) {
    out->org_x[i] = rays[i].origin[0];
    out->org_y[i] = rays[i].origin[1];
    out->org_z[i] = rays[i].origin[2];
    out->tnear[i] = rays[i].tnear;
    out->dir_x[i] = rays[i].dir[0];
    out->dir_y[i] = rays[i].dir[1];
    out->dir_z[i] = rays[i].dir[2];
    out->tfar[i] = rays[i].tfar;
    out->time[i] = 0.0f;
    out->mask[i] = mask;
    out->id[i] = 0;
    out->flags[i] = 0;
  }
}

static dome_hit to_hit(float t, float u, float v, unsigned geometry, unsigned instance, unsigned triangle) {
  dome_hit miss = {INFINITY, 0.0f, 0.0f, RTC_INVALID_GEOMETRY_ID, 0};
  if (geometry == RTC_INVALID_GEOMETRY_ID) return miss;
  dome_hit hit = {t, u, v, instance == RTC_INVALID_GEOMETRY_ID ? geometry : instance, triangle};
  return hit;
}

static void intersect_packets(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask,
                              dome_hit *hits) {
  intersect_args args = make_intersect_args(true);
  for (size_t first = 0; first < count; first += 16) {
    size_t n = count - first < 16 ? count - first : 16;
    _Alignas(64) int32_t lanes[16];
    _Alignas(64) struct RTCRayHit16 packet;
    to_rtc16(rays + first, n, mask, &packet.ray, lanes);
    for (size_t i = 0; i < 16; i++) {
      packet.hit.geomID[i] = RTC_INVALID_GEOMETRY_ID;
      packet.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
    }
    INTERSECT16(lanes, embree->world, &args, &packet);
    for (size_t i = 0; i < n; i++)
      hits[first + i] = to_hit(packet.ray.tfar[i], packet.hit.u[i], packet.hit.v[i], packet.hit.geomID[i],
                               packet.hit.instID[0][i], packet.hit.primID[i]);
  }
}

void dome_intersect(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask, uint32_t coherent,
                    dome_hit *hits) {
  if (coherent && count >= 8 && !embree->single) {
    intersect_packets(embree, rays, count, mask, hits);
    return;
  }
  /* One by one: streams of scattered rays gain nothing here. */
  intersect_args args = make_intersect_args(false);
  for (size_t i = 0; i < count; i++) {
    struct RTCRayHit query;
    memset(&query.hit, 0, sizeof query.hit);
    query.ray = to_rtc(&rays[i], mask);
    query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
    INTERSECT1(embree->world, &args, &query);
    hits[i] = to_hit(query.ray.tfar, query.hit.u, query.hit.v, query.hit.geomID, query.hit.instID[0],
                     query.hit.primID);
  }
}

static void occluded_single(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask,
                            uint8_t *occluded) {
  occluded_args args = make_occluded_args();
  for (size_t i = 0; i < count; i++) {
    struct RTCRay ray = to_rtc(&rays[i], mask);
    OCCLUDED1(embree->world, &args, &ray);
    occluded[i] = ray.tfar < 0.0f;
  }
}

#if RTC_VERSION_MAJOR >= 4
/* Packets of 16 are up to 29 % faster than single rays, and never slower. */
static void occluded_batch(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask,
                           uint8_t *occluded) {
  occluded_args args = make_occluded_args();
  for (size_t first = 0; first < count; first += 16) {
    size_t n = count - first < 16 ? count - first : 16;
    _Alignas(64) int32_t lanes[16];
    _Alignas(64) struct RTCRay16 packet;
    to_rtc16(rays + first, n, mask, &packet, lanes);
    OCCLUDED16(lanes, embree->world, &args, &packet);
    for (size_t i = 0; i < n; i++) occluded[first + i] = packet.tfar[i] < 0.0f;
  }
}
#else
/* Embree 3's streams are 20 to 90 % faster than single rays: they sort a block by octant and go through the tree with
 * several rays at a time. Embree 4 has no such call. Blocks of 256 are better than of 64 (+10 to +20 % on small scenes). */
enum { BLOCK = 256 };

static void occluded_batch(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask,
                           uint8_t *occluded) {
  occluded_args args = make_occluded_args();
  struct RTCRay block[BLOCK];
  for (size_t first = 0; first < count; first += BLOCK) {
    size_t n = count - first < BLOCK ? count - first : BLOCK;
    for (size_t i = 0; i < n; i++) block[i] = to_rtc(&rays[first + i], mask);
    rtcOccluded1M(embree->world, &args, block, (unsigned)n, sizeof block[0]);
    for (size_t i = 0; i < n; i++) occluded[first + i] = block[i].tfar < 0.0f;
  }
}
#endif

void dome_occluded(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask, uint8_t *occluded) {
  if (embree->single)
    occluded_single(embree, rays, count, mask, occluded);
  else
    occluded_batch(embree, rays, count, mask, occluded);
}
