//! The accelerators under test, and generated geometry and rays for them.

use domelight::accel::{self, Accel, Coherence, Hit, Mask, Ray};
use domelight::scene::{AlphaMode, Instance, Material, Mesh, Scene};
use glam::{Affine3A, Mat3A, Vec3};
use std::sync::Arc;

/// SplitMix64: enough for test data.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    /// The next 64 bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// In [0, 1).
    pub(crate) fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }
    /// Below `limit`.
    pub(crate) fn below(&mut self, limit: usize) -> usize {
        (self.bits() % limit as u64) as usize
    }
    /// In the cube from −1 to 1.
    pub(crate) fn in_cube(&mut self) -> Vec3 {
        Vec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
    }
    /// Uniform on the sphere.
    pub(crate) fn direction(&mut self) -> Vec3 {
        loop {
            let p = self.in_cube();
            let l = p.length();
            if l > 1e-3 && l < 1.0 {
                return p / l;
            }
        }
    }
}

/// Unconnected triangles of about `size` in the unit cube.
pub(crate) fn soup(triangles: usize, size: f32, seed: u64) -> Mesh {
    let mut random = Random(seed);
    let mut mesh = Mesh::default();
    for i in 0..triangles as u32 {
        let centre = random.in_cube();
        mesh.positions.extend((0..3).map(|_| centre + random.in_cube() * size));
        mesh.indices.push([3 * i, 3 * i + 1, 3 * i + 2]);
    }
    mesh
}

/// The cube from −1 to 1, `n` × `n` squares a side, every vertex shared by what touches it.
pub(crate) fn closed_box(n: u32) -> Mesh {
    let mut mesh = Mesh::default();
    let mut known = std::collections::HashMap::new();
    for axis in 0..3 {
        for side in [0, n] {
            let mut vertex = |a: u32, b: u32| {
                let mut key = [0; 3];
                (key[axis], key[(axis + 1) % 3], key[(axis + 2) % 3]) = (side, a, b);
                *known.entry(key).or_insert_with(|| {
                    mesh.positions.push(Vec3::from(key.map(|k| 2.0 * k as f32 / n as f32 - 1.0)));
                    mesh.positions.len() as u32 - 1
                })
            };
            for (a, b) in (0..n).flat_map(|a| (0..n).map(move |b| (a, b))) {
                let quad = [vertex(a, b), vertex(a + 1, b), vertex(a + 1, b + 1), vertex(a, b + 1)];
                let pair = [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]];
                mesh.indices.extend(pair.map(|[i, j, k]| if side == 0 { [i, k, j] } else { [i, j, k] }));
            }
        }
    }
    mesh
}

/// Adds a mesh with a material of its own and an instance at the origin.
pub(crate) fn add_mesh(scene: &mut Scene, mut mesh: Mesh, alpha: AlphaMode) -> u32 {
    mesh.material = scene.materials.len() as u32;
    scene.materials.push(Material { alpha, ..Material::default() });
    scene.meshes.push(mesh);
    let index = scene.meshes.len() as u32 - 1;
    add_instance(scene, index, Affine3A::IDENTITY);
    index
}

/// Adds an instance.
pub(crate) fn add_instance(scene: &mut Scene, mesh: u32, transform: Affine3A) {
    let linear: Mat3A = transform.matrix3;
    scene.instances.push(Instance {
        mesh,
        transform,
        normal_matrix: linear.inverse().transpose(),
        flipped: linear.determinant() < 0.0,
        identity: transform == Affine3A::IDENTITY,
    });
}

/// The finished scene.
pub(crate) fn scene_of(scene: Scene) -> Arc<Scene> {
    Arc::new(scene)
}

/// The accelerators under test: all but the oracle, each with its options.
pub(crate) fn specs() -> Vec<String> {
    let mut specs: Vec<String> = accel::ACCELS.iter().map(|p| p.name.to_owned()).collect();
    if specs.iter().any(|s| s == "embree") {
        specs.extend(["embree:quality=high,robust=off", "embree:quality=low,compact=on"].map(str::to_owned));
    }
    // Vector code that this processor lacks is an error, and nothing to test.
    let empty = scene_of(Scene::default());
    let kernels = ["bvh:isa=avx512", "bvh:isa=avx2", "bvh:isa=portable"];
    specs.extend(kernels.iter().filter(|s| accel::build(s, &empty, 1).is_ok()).map(|s| (*s).to_owned()));
    specs
}

pub(crate) fn build(spec: &str, scene: &Arc<Scene>) -> Box<dyn Accel> {
    accel::build(spec, scene, 2).unwrap_or_else(|e| panic!("{spec}: {e}"))
}

pub(crate) fn intersect(accel: &dyn Accel, rays: &[Ray], mask: Mask, coherence: Coherence) -> Vec<Hit> {
    let mut hits = vec![Hit::MISS; rays.len()];
    accel.intersect(rays, mask, coherence, &mut hits);
    hits
}

pub(crate) fn occluded(accel: &dyn Accel, rays: &[Ray], mask: Mask) -> Vec<u8> {
    let mut answers = vec![7; rays.len()];
    accel.occluded(rays, mask, &mut answers);
    assert!(answers.iter().all(|a| *a <= 1), "answers are 0 or 1");
    answers
}

/// Rays from in and around the unit cube to anywhere, some with limits.
pub(crate) fn rays(count: usize, seed: u64) -> Vec<Ray> {
    let mut random = Random(seed);
    let mut rays = Vec::with_capacity(count);
    for i in 0..count {
        let mut ray = Ray::new(random.in_cube() * 3.0, random.direction() * (0.5 + random.unit()));
        if i % 4 == 1 {
            ray.tnear = random.unit();
            ray.tfar = ray.tnear + 2.0 * random.unit();
        }
        rays.push(ray);
    }
    rays
}
