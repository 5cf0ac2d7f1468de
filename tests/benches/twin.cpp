// What `embree` does through Rust and the shim, in C++ alone: the same triangles, rays and calls to Embree. twin.rs
// compiles it, writes the file and says when to go: `twin FILE`, then a line a pass on standard input, "camera",
// "closest", "single" or "stream"; each is answered by the pass's processor seconds and its hits.
//
// The file, little-endian: how many vertices, triangles, camera rays, scattered rays and rays in groups (u32), then
// positions (3 floats), indices (3 u32) and the rays (origin, tnear, dir, tfar: 8 floats).
#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

struct Ray {
  float origin[3], tnear, dir[3], tfar;
};
struct Hit {
  float t, u, v;
  uint32_t instance, triangle;
};

constexpr size_t BATCH = 256;
static RTCScene scene;
static Hit hits[BATCH];
static uint8_t occluded[BATCH];

#if RTC_VERSION_MAJOR >= 4
struct Closest : RTCIntersectArguments {
  explicit Closest(bool coherent) {
    rtcInitIntersectArguments(this);
    flags = coherent ? RTC_RAY_QUERY_FLAG_COHERENT : RTC_RAY_QUERY_FLAG_INCOHERENT;
    feature_mask = RTCFeatureFlags(RTC_FEATURE_FLAG_TRIANGLE | RTC_FEATURE_FLAG_INSTANCE);
  }
};
struct Any : RTCOccludedArguments {
  Any() {
    rtcInitOccludedArguments(this);
    feature_mask = RTCFeatureFlags(RTC_FEATURE_FLAG_TRIANGLE | RTC_FEATURE_FLAG_INSTANCE);
  }
};
static void intersect1(Closest &args, RTCRayHit &query) { rtcIntersect1(scene, &query, &args); }
static void intersect16(const int *lanes, Closest &args, RTCRayHit16 &packet) {
  rtcIntersect16(lanes, scene, &packet, &args);
}
static void occluded1(Any &args, RTCRay &ray) { rtcOccluded1(scene, &ray, &args); }
#else
struct Closest : RTCIntersectContext {
  explicit Closest(bool coherent) {
    rtcInitIntersectContext(this);
    flags = coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
  }
};
struct Any : Closest {
  Any() : Closest(false) {}
};
static void intersect1(Closest &args, RTCRayHit &query) { rtcIntersect1(scene, &args, &query); }
static void intersect16(const int *lanes, Closest &args, RTCRayHit16 &packet) {
  rtcIntersect16(lanes, scene, &args, &packet);
}
static void occluded1(Any &args, RTCRay &ray) { rtcOccluded1(scene, &args, &ray); }
#endif

static RTCRay to_rtc(const Ray &r) {
  RTCRay out{};
  out.org_x = r.origin[0], out.org_y = r.origin[1], out.org_z = r.origin[2], out.tnear = r.tnear;
  out.dir_x = r.dir[0], out.dir_y = r.dir[1], out.dir_z = r.dir[2], out.tfar = r.tfar;
  out.mask = 3;
  return out;
}

template <typename Packet>
static void fill(Packet &p, const Ray *rays, size_t n, int *lanes) {
  for (size_t i = 0; i < 16; i++) {
    const Ray &r = rays[i < n ? i : 0];
    lanes[i] = i < n ? -1 : 0;
    p.org_x[i] = r.origin[0], p.org_y[i] = r.origin[1], p.org_z[i] = r.origin[2], p.tnear[i] = r.tnear;
    p.dir_x[i] = r.dir[0], p.dir_y[i] = r.dir[1], p.dir_z[i] = r.dir[2], p.tfar[i] = r.tfar;
    p.time[i] = 0, p.mask[i] = 3, p.id[i] = 0, p.flags[i] = 0;
  }
}

static Hit to_hit(float t, float u, float v, unsigned geometry, unsigned triangle) {
  return geometry == RTC_INVALID_GEOMETRY_ID ? Hit{INFINITY, 0, 0, geometry, 0} : Hit{t, u, v, geometry, triangle};
}

// Coherent packets of 16.
static void camera(const Ray *rays, size_t count) {
  Closest args(true);
  for (size_t first = 0; first < count; first += 16) {
    size_t n = std::min<size_t>(16, count - first);
    alignas(64) int lanes[16];
    alignas(64) RTCRayHit16 packet;
    fill(packet.ray, rays + first, n, lanes);
    for (size_t i = 0; i < 16; i++) packet.hit.geomID[i] = packet.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
    intersect16(lanes, args, packet);
    for (size_t i = 0; i < n; i++)
      hits[first + i] = to_hit(packet.ray.tfar[i], packet.hit.u[i], packet.hit.v[i], packet.hit.geomID[i],
                               packet.hit.primID[i]);
  }
}

static void closest(const Ray *rays, size_t count) {
  Closest args(false);
  for (size_t i = 0; i < count; i++) {
    RTCRayHit query{};
    query.ray = to_rtc(rays[i]);
    query.hit.geomID = query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
    intersect1(args, query);
    hits[i] = to_hit(query.ray.tfar, query.hit.u, query.hit.v, query.hit.geomID, query.hit.primID);
  }
}

static void single(const Ray *rays, size_t count) {
  Any args;
  for (size_t i = 0; i < count; i++) {
    RTCRay ray = to_rtc(rays[i]);
    occluded1(args, ray);
    occluded[i] = ray.tfar < 0;
  }
}

// Embree 3's stream; packets of 16 on Embree 4.
static void stream(const Ray *rays, size_t count) {
  Any args;
#if RTC_VERSION_MAJOR >= 4
  for (size_t first = 0; first < count; first += 16) {
    size_t n = std::min<size_t>(16, count - first);
    alignas(64) int lanes[16];
    alignas(64) RTCRay16 packet;
    fill(packet, rays + first, n, lanes);
    rtcOccluded16(lanes, scene, &packet, &args);
    for (size_t i = 0; i < n; i++) occluded[first + i] = packet.tfar[i] < 0;
  }
#else
  RTCRay block[BATCH];
  for (size_t i = 0; i < count; i++) block[i] = to_rtc(rays[i]);
  rtcOccluded1M(scene, &args, block, unsigned(count), sizeof block[0]);
  for (size_t i = 0; i < count; i++) occluded[i] = block[i].tfar < 0;
#endif
}

static double processor_seconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

int main(int, char **argv) {
  std::ifstream file(argv[1], std::ios::binary);
  uint32_t counts[5];
  file.read(reinterpret_cast<char *>(counts), sizeof counts);
  RTCDevice device = rtcNewDevice("threads=1");
  scene = rtcNewScene(device);
  rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
  RTCGeometry mesh = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
  void *vertices = rtcSetNewGeometryBuffer(mesh, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, counts[0]);
  void *indices = rtcSetNewGeometryBuffer(mesh, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, counts[1]);
  file.read(static_cast<char *>(vertices), std::streamsize(counts[0]) * 12);
  file.read(static_cast<char *>(indices), std::streamsize(counts[1]) * 12);
  rtcSetGeometryMask(mesh, 1);
  rtcCommitGeometry(mesh);
  rtcAttachGeometryByID(scene, mesh, 0);
  rtcCommitScene(scene);
  std::vector<Ray> rays[3];
  for (int i = 0; i < 3; i++) rays[i].resize(counts[2 + i]);
  for (auto &set : rays) file.read(reinterpret_cast<char *>(set.data()), std::streamsize(set.size() * sizeof(Ray)));
  if (!file || rtcGetDeviceError(device) != RTC_ERROR_NONE) return 2;

  for (std::string kind; std::getline(std::cin, kind);) {
    const auto &set = rays[kind == "camera" ? 0 : kind == "closest" ? 1 : 2];
    auto *call = kind == "camera" ? camera : kind == "closest" ? closest : kind == "single" ? single : stream;
    bool nearest = kind == "camera" || kind == "closest";
    double start = processor_seconds();
    uint64_t met = 0;
    for (size_t first = 0; first < set.size(); first += BATCH) {
      size_t n = std::min(BATCH, set.size() - first);
      call(set.data() + first, n);
      for (size_t i = 0; i < n; i++) met += nearest ? hits[i].instance != RTC_INVALID_GEOMETRY_ID : occluded[i];
    }
    std::cout << processor_seconds() - start << ' ' << met << std::endl;
  }
}
