/* The whole of Embree as Rust sees it: plain structs and batch calls. Rust's side is made from this file by bindgen
 * (build.rs), Embree's own structs stay inside embree.c, which is compiled against the header that is installed.
 *
 * A call that returns int returns 0 when it went well; dome_error() then tells what did not. */
#ifndef DOMELIGHT_EMBREE_H
#define DOMELIGHT_EMBREE_H

#include <stddef.h>
#include <stdint.h>

/* A device, its scenes and copies of the meshes. Building is one thread's work, asking is everybody's. */
typedef struct dome_embree dome_embree;

/* domelight's accel::Ray. */
typedef struct dome_ray {
  float origin[3];
  float tnear;
  float dir[3];
  float tfar;
} dome_ray;

/* domelight's accel::Hit; instance is 0xffffffff for a miss. */
typedef struct dome_hit {
  float t;
  float u;
  float v;
  uint32_t instance;
  uint32_t triangle;
} dome_hit;

/* How to build. */
typedef struct dome_options {
  uint32_t threads;
  uint32_t quality; /* 0 low, 1 medium, 2 high */
  uint32_t robust;
  uint32_t compact;
  uint32_t single; /* one ray a call to Embree: to compare with */
} dome_options;

/* A mesh to copy: xyz triples of floats and index triples, each index below vertex_count. */
typedef struct dome_mesh {
  const float *positions;
  const uint32_t *indices;
  size_t vertex_count;
  size_t triangle_count;
  uint32_t mask;
} dome_mesh;

/* Bytes Embree has asked the system for. */
typedef struct dome_memory {
  int64_t bytes;
  int64_t peak_bytes;
} dome_memory;

/* NULL only when memory ran out. Check dome_error() before going on. */
dome_embree *dome_create(const dome_options *options);
void dome_destroy(dome_embree *embree);

/* What went wrong first; NULL if nothing did. Lives as long as the handle. */
const char *dome_error(const dome_embree *embree);

/* Puts a mesh into the world as the geometry of instance `instance`. */
int dome_add_mesh(dome_embree *embree, const dome_mesh *mesh, uint32_t instance);

/* Builds a mesh that instances share; its number, counted from 0 in the order of the calls, names it afterwards. */
int dome_add_shared(dome_embree *embree, const dome_mesh *mesh);

/* Puts a shared mesh into the world as instance `instance`; `transform` is four columns of three. */
int dome_add_instance(dome_embree *embree, uint32_t shared, uint32_t mask, const float transform[12],
                      uint32_t instance);

/* Builds the world. No mesh may be added afterwards. */
int dome_commit(dome_embree *embree);

/* Rays must be valid (accel::Ray::is_valid, also in the space of every instance): Debian's Embree 3 aborts otherwise. */
void dome_intersect(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask, uint32_t coherent,
                    dome_hit *hits);
void dome_occluded(const dome_embree *embree, const dome_ray *rays, size_t count, uint32_t mask, uint8_t *occluded);

dome_memory dome_memory_used(const dome_embree *embree);

/* 31305 is 3.13.5: of the library that runs. */
uint32_t dome_library_version(const dome_embree *embree);

#endif
