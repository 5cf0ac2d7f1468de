//! Scenes made on the spot: `terrain:300k`, `soup:1M`, `forest:10M`.

use anyhow::{Context, bail};
use domelight::dome::project::Grid;
use domelight::dome::{Dome, Faults};
use domelight::random::{hash, unit};
use domelight::scene::{Instance, Material, Mesh, Scene};
use glam::{Affine3A, Mat3A, Quat, Vec3};
use std::f32::consts::TAU;

/// A scene of about the number of triangles that follows the kind; `k` and `M` are understood.
pub(super) fn generate(spec: &str) -> anyhow::Result<Scene> {
    let (kind, count) = spec.split_once(':').context("--generate takes KIND:TRIANGLES, such as terrain:300k")?;
    let count = parse_count(count)?;
    let matt = Material { metallic: 0.0, specular: 0.0, double_sided: true, ..Material::default() };
    let mut scene = Scene { materials: vec![matt], ..Scene::default() };
    match kind {
        "terrain" => {
            let mesh = terrain(count);
            place(&mut scene, mesh, &[Affine3A::IDENTITY]);
        }
        "soup" => {
            let mesh = soup(count);
            place(&mut scene, mesh, &[Affine3A::IDENTITY]);
        }
        "forest" => forest(&mut scene, count),
        _ => bail!("--generate knows terrain, soup and forest, not '{kind}'"),
    }
    bounds(&mut scene);
    Ok(scene)
}

/// A clear sky: brighter towards the horizon, with a sun three degrees across that gives half of the light.
pub(super) fn sky() -> Dome {
    let grid = Grid::new(1024, 512, 0.0);
    let sun = Vec3::new(0.5, 0.6, 0.4).normalize();
    let radiance = |i: u32| {
        let dir = grid.direction(f64::from(i % grid.width) + 0.5, f64::from(i / grid.width) + 0.5);
        let sky =
            if dir.y > 0.0 { Vec3::new(0.9, 1.0, 1.2) - dir.y * Vec3::new(0.7, 0.5, 0.2) } else { Vec3::splat(0.2) };
        (sky + if dir.dot(sun) > 0.999_66 { 1500.0 } else { 0.0 }).to_array()
    };
    Dome { grid, texels: (0..grid.len() as u32).map(radiance).collect(), faults: Faults::default() }
}

fn parse_count(text: &str) -> anyhow::Result<usize> {
    let (digits, factor) = match text.strip_suffix(['k', 'K', 'm', 'M']) {
        Some(digits) if text.ends_with(['k', 'K']) => (digits, 1_000),
        Some(digits) => (digits, 1_000_000),
        None => (text, 1),
    };
    let count = digits.parse::<usize>().ok().and_then(|n| n.checked_mul(factor));
    count
        .filter(|n| (1..=100_000_000).contains(n))
        .with_context(|| format!("'{text}' is not 1..100M triangles, as in terrain:300k"))
}

fn random(words: &[u32]) -> f32 {
    unit(hash(words))
}

/// Smooth noise in [0, 1) on a lattice of unit cells.
fn noise(p: Vec3) -> f32 {
    let (cell, f) = (p.floor().as_ivec3(), p - p.floor());
    let f = f * f * (3.0 - 2.0 * f);
    let at = |x: i32, y: i32, z: i32| random(&[(cell.x + x) as u32, (cell.y + y) as u32, (cell.z + z) as u32]);
    let line = |y, z| at(0, y, z) * (1.0 - f.x) + at(1, y, z) * f.x;
    let plane = |z| line(0, z) * (1.0 - f.y) + line(1, z) * f.y;
    plane(0) * (1.0 - f.z) + plane(1) * f.z
}

fn mountains(p: Vec3) -> f32 {
    (0..6).map(|octave| noise(p * (1 << octave) as f32) / (1 << octave) as f32).sum()
}

/// A grid of `across` × `down` quads through `vertex(u, v)`.
fn grid(mesh: &mut Mesh, across: usize, down: usize, vertex: impl Fn(f32, f32) -> Vec3) {
    let first = mesh.positions.len() as u32;
    for j in 0..=down {
        for i in 0..=across {
            mesh.positions.push(vertex(i as f32 / across as f32, j as f32 / down as f32));
        }
    }
    let row = across as u32 + 1;
    for j in 0..down as u32 {
        for i in 0..across as u32 {
            let a = first + j * row + i;
            mesh.indices.extend([[a, a + row, a + 1], [a + 1, a + row, a + row + 1]]);
        }
    }
}

fn sphere(mesh: &mut Mesh, triangles: usize, centre: Vec3, radius: f32, rough: f32) {
    let down = ((triangles as f32 / 4.0).sqrt() as usize).max(3);
    grid(mesh, 2 * down, down, |u, v| {
        let (theta, phi) = (v * TAU / 2.0, u * TAU);
        let dir = Vec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
        centre + dir * radius * (1.0 + rough * (mountains(dir * 4.0 + centre) - 1.0))
    });
}

/// Half a landscape of mountains, half 24 rough spheres over it.
fn terrain(triangles: usize) -> Mesh {
    let mut mesh = Mesh::default();
    let side = ((triangles as f32 / 4.0).sqrt() as usize).max(2);
    grid(&mut mesh, side, side, |u, v| {
        let p = Vec3::new(u * 20.0 - 10.0, 0.0, v * 20.0 - 10.0);
        p + Vec3::Y * 1.5 * mountains(p * 0.4 + 100.0)
    });
    for i in 0..24 {
        let at = |word| random(&[i, word]) * 18.0 - 9.0;
        let centre = Vec3::new(at(1), 2.5 + 2.0 * random(&[i, 3]), at(2));
        sphere(&mut mesh, triangles / 48, centre, 0.4 + random(&[i, 4]), 0.3);
    }
    mesh
}

/// Unconnected triangles of any direction.
fn soup(triangles: usize) -> Mesh {
    let size = 1.5 * (triangles as f32).cbrt().recip() * 10.0;
    let mut mesh = Mesh::default();
    for i in 0..triangles as u32 {
        let point = |k: u32| Vec3::new(random(&[i, k]), random(&[i, k + 1]), random(&[i, k + 2])) - 0.5;
        let centre = point(0) * 20.0;
        mesh.positions.extend([3, 6, 9].map(|k| centre + point(k) * size));
        mesh.indices.push([3 * i, 3 * i + 1, 3 * i + 2]);
    }
    mesh
}

/// One rough sphere of 20,000 triangles, instanced until the number is reached, over a plain.
fn forest(scene: &mut Scene, triangles: usize) {
    let mut tree = Mesh::default();
    sphere(&mut tree, 20_000.min(triangles), Vec3::ZERO, 1.0, 0.6);
    let count = (triangles / tree.indices.len()).max(2) as u32;
    let transforms: Vec<_> = (0..count)
        .map(|i| {
            let at = |word| random(&[i, word]) * 18.0 - 9.0;
            let size = 4.0 / (count as f32).sqrt() * (0.5 + random(&[i, 3]));
            let turn = Quat::from_rotation_y(random(&[i, 4]) * TAU);
            let size = Vec3::new(size, size * (1.0 + random(&[i, 5])), size);
            Affine3A::from_scale_rotation_translation(size, turn, Vec3::new(at(1), 1.0, at(2)))
        })
        .collect();
    place(scene, tree, &transforms);
    let mut plain = Mesh::default();
    grid(&mut plain, 8, 8, |u, v| Vec3::new(u * 20.0 - 10.0, 0.0, v * 20.0 - 10.0));
    place(scene, plain, &[Affine3A::IDENTITY]);
}

fn place(scene: &mut Scene, mesh: Mesh, transforms: &[Affine3A]) {
    scene.meshes.push(mesh);
    for transform in transforms {
        let linear: Mat3A = transform.matrix3;
        scene.instances.push(Instance {
            mesh: scene.meshes.len() as u32 - 1,
            transform: *transform,
            normal_matrix: linear.inverse().transpose(),
            flipped: linear.determinant() < 0.0,
            identity: *transform == Affine3A::IDENTITY,
        });
    }
}

fn bounds(scene: &mut Scene) {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for instance in &scene.instances {
        for p in &scene.meshes[instance.mesh as usize].positions {
            let p = instance.transform.transform_point3(*p);
            (low, high) = (low.min(p), high.max(p));
        }
    }
    scene.bounds = [low, high];
}
