//! Small scenes made in memory, and renders of them: what closed forms and unbiasedness are tested on.

use domelight::accel;
use domelight::dome::Dome;
use domelight::film::Filter;
use domelight::integrator::INTEGRATORS;
use domelight::registry::resolve;
use domelight::render::{Background, Picture, Render, Settings, Watch};
use domelight::sampler::DomeSampler;
use domelight::scene::{Camera, Instance, Material, Mesh, Projection, Scene, View};
use glam::{Affine3A, DVec3, Mat3A, Vec3, Vec4};
use std::f64::consts::{PI, TAU};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// White, Lambertian and nothing else.
pub(crate) fn white() -> Material {
    Material { base_color: Vec4::ONE, metallic: 0.0, specular: 0.0, double_sided: true, ..Material::default() }
}

/// Triangles fanned from a convex outline.
pub(crate) fn polygon(corners: &[Vec3]) -> Mesh {
    let indices = (1..corners.len() as u32 - 1).map(|i| [0, i, i + 1]).collect();
    Mesh { positions: corners.to_vec(), indices, ..Mesh::default() }
}

/// A square of half-side `half` about `center`, facing `n`.
pub(crate) fn square(center: Vec3, n: Vec3, half: f32) -> Mesh {
    let (a, b) = n.any_orthonormal_pair();
    polygon(&[(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| center + (a * x + b * y) * half))
}

/// The box between two corners.
pub(crate) fn cuboid(low: Vec3, high: Vec3) -> Mesh {
    let mut mesh = super::accel::closed_box(1);
    for p in &mut mesh.positions {
        *p = low + (*p + 1.0) * 0.5 * (high - low);
    }
    mesh
}

/// A grid of `columns` × `rows` quads bent into shape by `place` (both coordinates in [0, 1]).
pub(crate) fn sheet(columns: u32, rows: u32, place: impl Fn(f64, f64) -> Vec3) -> Mesh {
    let mut mesh = Mesh::default();
    for (j, i) in (0..=rows).flat_map(|j| (0..=columns).map(move |i| (j, i))) {
        mesh.positions.push(place(f64::from(i) / f64::from(columns), f64::from(j) / f64::from(rows)));
        if i < columns && j < rows {
            let at = j * (columns + 1) + i;
            let below = at + columns + 1;
            mesh.indices.extend([[at, at + 1, below + 1], [at, below + 1, below]]);
        }
    }
    mesh
}

/// All around, by two numbers in [0, 1].
pub(crate) fn direction(u: f64, v: f64) -> Vec3 {
    let ((sin, cos), (ring, up)) = ((TAU * u).sin_cos(), (PI * v).sin_cos());
    DVec3::new(ring * cos, up, ring * sin).as_vec3()
}

/// A smooth ball.
pub(crate) fn sphere(middle: Vec3, radius: f32) -> Mesh {
    let mut sphere = sheet(256, 128, direction);
    sphere.normals = sphere.positions.clone();
    sphere.positions.iter_mut().for_each(|place| *place = middle + radius * *place);
    sphere
}

/// Meshes in world space, each with its material.
pub(crate) fn scene(parts: Vec<(Mesh, Material)>) -> Arc<Scene> {
    let mut scene = Scene::default();
    for (i, (mut mesh, material)) in parts.into_iter().enumerate() {
        mesh.material = i as u32;
        scene.needs.gloss |= !material.is_diffuse();
        scene.materials.push(material);
        scene.meshes.push(mesh);
        scene.instances.push(Instance {
            mesh: i as u32,
            transform: Affine3A::IDENTITY,
            normal_matrix: Mat3A::IDENTITY,
            flipped: false,
            identity: true,
        });
    }
    Arc::new(scene)
}

/// A camera that looks straight at `point` from `distance` along `n` and sees next to nothing beside it.
pub(crate) fn microscope(point: Vec3, n: Vec3, distance: f32) -> Camera {
    let (a, b) = n.any_orthonormal_pair();
    let transform = Affine3A {
        matrix3: Mat3A::from_cols(a.into(), b.into(), n.into()),
        translation: (point + n * distance).into(),
    };
    Camera { name: "microscope".into(), transform, projection: Projection::Orthographic { ymag: 1e-5 } }
}

/// More camera rays than the shaded ones: what they are taken for must not move the mean, whatever the cache holds.
pub(crate) const BESIDE: Option<u32> = Some(3);

/// How a test renders.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shot<'a> {
    pub(crate) scene: &'a Arc<Scene>,
    pub(crate) dome: &'a Arc<Dome>,
    pub(crate) camera: &'a Camera,
    pub(crate) accel: &'a dyn accel::Accel,
    pub(crate) side: u32,
    pub(crate) spp: u32,
    pub(crate) rays: u32,
    pub(crate) camera_rays: Option<u32>,
    pub(crate) tile: u32,
}

impl Shot<'_> {
    /// The render itself, misses black.
    pub(crate) fn take(&self, sampler: &mut dyn DomeSampler, seed: u32) -> Picture {
        self.run(sampler, seed, [0, 0, self.side, self.side], [false; 2])
    }

    /// The same with further layers.
    pub(crate) fn take_layers(&self, sampler: &mut dyn DomeSampler, seed: u32) -> Picture {
        self.run(sampler, seed, [0, 0, self.side, self.side], [true, false])
    }

    /// The same in replicates, with variances.
    pub(crate) fn take_measured(&self, sampler: &mut dyn DomeSampler, seed: u32) -> Picture {
        self.run(sampler, seed, [0, 0, self.side, self.side], [false, true])
    }

    /// A part of it: first column, first row, columns, rows.
    pub(crate) fn crop(&self, crop: [u32; 4], sampler: &mut dyn DomeSampler, seed: u32) -> Picture {
        self.run(sampler, seed, crop, [false; 2])
    }

    fn run(&self, sampler: &mut dyn DomeSampler, seed: u32, crop: [u32; 4], [aovs, variance]: [bool; 2]) -> Picture {
        let (plugin, params) = resolve("integrator", INTEGRATORS, "direct").unwrap();
        let integrator = (plugin.make)(&params).unwrap();
        let view = View::new(self.camera, self.side, self.side);
        let settings = Settings {
            size: [self.side; 2],
            crop,
            spp: self.spp,
            rays: self.rays,
            camera_rays: self.camera_rays,
            seed,
            tile: self.tile,
            filter: Filter::Box,
            background: Background::Black,
            aovs,
            variance,
            time: None,
        };
        let render = Render {
            scene: self.scene,
            accel: self.accel,
            dome: self.dome,
            integrator: integrator.as_ref(),
            view: &view,
            settings,
        };
        render.run(sampler, Watch { finish: &AtomicBool::new(false), progress: &|_| () })
    }

    /// The view of this shot.
    pub(crate) fn view(&self) -> View {
        View::new(self.camera, self.side, self.side)
    }
}

/// A picture's pixels.
pub(crate) fn pixels(picture: &Picture) -> Vec<Vec3> {
    picture.film.rgba().chunks_exact(4).map(|p| Vec3::new(p[0], p[1], p[2])).collect()
}
