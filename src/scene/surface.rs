//! From a hit to a [`Surface`]: where it is and how exactly that is known, which way it faces, what it is made of.
//!
//! Accelerators report barycentrics; the position is recomputed from the triangle's corners, so that its error depends
//! on the corners' coordinates, not on the ray's length. Steps whose rounding would matter are done in f64.

use super::{AlphaMode, Instance, Material, Mesh, Scene, Surface, TextureRef};
use crate::accel::{Hit, Ray};
use crate::simd::prefetch;
use glam::{DVec3, Vec2, Vec3, Vec3A, Vec4};

/// Half the distance from 1 to the next f32: the relative error of one rounding.
const EPSILON: f32 = f32::EPSILON * 0.5;

/// How many roundings of coordinates the bound covers: one here, the others are those of the accelerator when a ray
/// starts at the position (into an instance's space, the corners relative to the origin, the edge products).
const ROUNDINGS: f32 = 8.0;

/// Least cosine between the shading normal and the direction to the viewer.
const LEAST_COSINE: f32 = 1e-3;

/// How many hits ahead a triangle's corners are asked for; its indices twice as many.
const AHEAD: usize = 4;

/// A hit's triangle, looked up once.
struct Triangle<'a> {
    instance: &'a Instance,
    mesh: &'a Mesh,
    material: &'a Material,
    corners: [usize; 3],
    weights: [f32; 3],
}

impl Triangle<'_> {
    #[inline]
    fn blend2(&self, values: &[Vec2]) -> Vec2 {
        if values.is_empty() {
            return Vec2::ZERO;
        }
        let [a, b, c] = self.corners.map(|i| values[i]);
        a * self.weights[0] + b * self.weights[1] + c * self.weights[2]
    }

    #[inline]
    fn blend3(&self, values: &[Vec3]) -> Vec3 {
        let [a, b, c] = self.corners.map(|i| values[i]);
        a * self.weights[0] + b * self.weights[1] + c * self.weights[2]
    }

    #[inline]
    fn blend4(&self, values: &[Vec4]) -> Vec4 {
        let [a, b, c] = self.corners.map(|i| values[i]);
        a * self.weights[0] + b * self.weights[1] + c * self.weights[2]
    }

    /// Where a texture is looked up.
    #[inline]
    fn uv(&self, texture: &TextureRef) -> Vec2 {
        texture.map(self.blend2(&self.mesh.uvs[usize::from(texture.uv_set)]))
    }

    /// The front's normal by the winding, in the instance's space, of any length.
    #[inline]
    fn winding(&self) -> DVec3 {
        let [a, b, c] = self.corners.map(|i| self.mesh.positions[i].as_dvec3());
        // A sliver's edges are nearly parallel: single precision would lose the normal.
        (b - a).cross(c - a)
    }

    /// The front's unit normal by the winding, world space; none for a triangle without area.
    #[inline]
    fn front(&self) -> Option<Vec3> {
        let n = self.winding().try_normalize()?.as_vec3();
        if self.instance.identity {
            return Some(n);
        }
        Vec3::from(self.instance.normal_matrix * Vec3A::from(n)).try_normalize()
    }

    /// A point of the instance's space in the world.
    #[inline]
    fn to_world(&self, p: DVec3) -> DVec3 {
        let m = &self.instance.transform;
        let column = |v: Vec3A| DVec3::new(f64::from(v.x), f64::from(v.y), f64::from(v.z));
        let (x, y, z) = (m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis);
        column(x) * p.x + column(y) * p.y + column(z) * p.z + column(m.translation)
    }

    /// The position and the bound on its error.
    #[inline]
    fn position(&self) -> (Vec3, f32) {
        let [a, b, c] = self.corners.map(|i| self.mesh.positions[i]);
        let (da, db, dc) = (a.as_dvec3(), b.as_dvec3(), c.as_dvec3());
        // Relative to a corner: weights that don't quite add up to one stay within the triangle's plane.
        let p = da + (db - da) * f64::from(self.weights[1]) + (dc - da) * f64::from(self.weights[2]);
        let inward = (da + db + dc) * (1.0 / 3.0) - p;
        let reach = a.abs().max(b.abs()).max(c.abs());
        if self.instance.identity {
            let error = bound(reach);
            return ((p + from_the_edge(inward, error)).as_vec3(), error);
        }
        let m = &self.instance.transform;
        let (x, y, z) = (m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis);
        // The errors made in the instance's space are as large as its coordinates carried over, without cancellation.
        let reach = x.abs() * reach.x + y.abs() * reach.y + z.abs() * reach.z + m.translation.abs();
        // A ray is carried into the instance's space and its errors come back: twice the way.
        let error = 2.0 * bound(Vec3::from(reach));
        let world = self.to_world(p);
        let inward = self.to_world(p + inward) - world;
        ((world + from_the_edge(inward, error)).as_vec3(), error)
    }
}

/// A step within the triangle towards its middle (`inward`), half of `error` long, so that rounding stays within it too.
/// Rounded, a point next to an edge may lie on the very plane of the triangle beyond the edge, and a ray from there
/// misses that: light would come into a closed box.
#[inline]
fn from_the_edge(inward: DVec3, error: f32) -> DVec3 {
    let (length, step) = (inward.length(), 0.5 * f64::from(error));
    if length > step { inward * (step / length) } else { inward }
}

#[inline]
fn bound(reach: Vec3) -> f32 {
    // The least normal number covers coordinates whose errors are below it.
    ROUNDINGS * EPSILON * reach.length() + f32::MIN_POSITIVE
}

impl Scene {
    /// Asks for the memory that what comes after the `i`th of `hits` will read: of many triangles hardly one is at hand.
    #[inline]
    pub fn look_ahead(&self, hits: &[Hit], i: usize) {
        let mesh = |hit: &Hit| &self.meshes[self.instances[hit.instance as usize].mesh as usize];
        if let Some(hit) = hits.get(i + 2 * AHEAD).filter(|hit| hit.is_hit()) {
            prefetch(&mesh(hit).indices, hit.triangle as usize);
        }
        if let Some(hit) = hits.get(i + AHEAD).filter(|hit| hit.is_hit()) {
            let mesh = mesh(hit);
            for corner in mesh.indices[hit.triangle as usize] {
                prefetch(&mesh.positions, corner as usize);
                if !mesh.normals.is_empty() {
                    prefetch(&mesh.normals, corner as usize);
                }
            }
        }
    }

    #[inline]
    fn hit_triangle(&self, hit: &Hit) -> Triangle<'_> {
        let instance = &self.instances[hit.instance as usize];
        let mesh = &self.meshes[instance.mesh as usize];
        Triangle {
            instance,
            mesh,
            material: &self.materials[mesh.material as usize],
            corners: mesh.indices[hit.triangle as usize].map(|i| i as usize),
            weights: [1.0 - hit.u - hit.v, hit.u, hit.v],
        }
    }

    /// `hit` with its distance and barycentrics computed from the triangle, in f64: a picture must not hang on the last bits
    /// of one structure's arithmetic. A ray along the triangle's plane keeps what it has.
    #[inline]
    pub fn refined(&self, ray: &Ray, hit: &Hit) -> Hit {
        let t = self.hit_triangle(hit);
        let [a, b, c] = t.corners.map(|i| t.mesh.positions[i].as_dvec3());
        let [a, b, c] = if t.instance.identity { [a, b, c] } else { [a, b, c].map(|p| t.to_world(p)) };
        // Möller and Trumbore 1997.
        let (from, dir) = (ray.origin.as_dvec3() - a, ray.dir.as_dvec3());
        let (along, across) = (b - a, c - a);
        let (p, q) = (dir.cross(across), from.cross(along));
        let [u, v, distance] = [from.dot(p), dir.dot(q), across.dot(q)].map(|x| x / along.dot(p));
        if !(u + v + distance).is_finite() {
            return *hit;
        }
        // The structure has decided that it is a hit: rounding at an edge must not leave the triangle.
        let u = u.clamp(0.0, 1.0);
        Hit { t: distance as f32, u: u as f32, v: v.clamp(0.0, 1.0 - u) as f32, ..*hit }
    }

    /// Where a hit is, and by how much that may err in each coordinate.
    pub fn place(&self, hit: &Hit) -> (Vec3, f32) {
        self.hit_triangle(hit).position()
    }

    /// What `ray` met at `hit`, ready to be shaded. The direction need not be of unit length.
    pub fn surface(&self, ray: &Ray, hit: &Hit) -> Surface {
        let (position, error) = self.place(hit);
        Surface { position, error, ..self.look(ray, hit) }
    }

    /// The same but for its place: enough for what traces no ray from there.
    pub fn look(&self, ray: &Ray, hit: &Hit) -> Surface {
        let t = self.hit_triangle(hit);
        let m = t.material;
        let [ng, ns] = self.normals_of(&t, ray);

        let mut base = m.base_color.truncate();
        if !t.mesh.colors.is_empty() {
            base *= t.blend4(&t.mesh.colors).truncate();
        }
        let look = |r: &TextureRef| self.textures[r.texture as usize].sample(t.uv(r));
        if let Some(r) = &m.base_color_texture {
            base *= look(r).truncate();
        }
        let (mut metallic, mut roughness) = (m.metallic, m.roughness);
        if let Some(r) = &m.metallic_roughness_texture {
            let texel = look(r);
            metallic *= texel.z;
            roughness *= texel.y;
        }
        let mut emission = m.emission;
        if let Some(r) = &m.emission_texture {
            emission *= look(r).truncate();
        }
        let (mut specular, mut color) = (m.specular, m.specular_color);
        if let Some(r) = &m.specular_texture {
            specular *= look(r).w;
        }
        if let Some(r) = &m.specular_color_texture {
            color *= look(r).truncate();
        }
        // KHR_materials_specular; an index of 0 stands for a Fresnel term of 1 (KHR_materials_ior).
        let f0 = if m.ior == 0.0 { 1.0 } else { ((m.ior - 1.0) / (m.ior + 1.0)).powi(2) };
        Surface {
            position: Vec3::NAN,
            error: f32::NAN,
            ng,
            ns,
            base_color: base,
            metallic,
            roughness,
            dielectric_f0: (color * f0).min(Vec3::ONE) * specular,
            dielectric_f90: specular,
            emission,
            unlit: m.unlit,
        }
    }

    /// Which way a hit faces, and that alone: the geometric and the shading normal of [`Self::look`].
    pub fn normals(&self, ray: &Ray, hit: &Hit) -> [Vec3; 2] {
        self.normals_of(&self.hit_triangle(hit), ray)
    }

    #[inline]
    fn normals_of(&self, t: &Triangle<'_>, ray: &Ray) -> [Vec3; 2] {
        let wo = -ray.dir.normalize_or(Vec3::NEG_Z);
        let front = t.front().unwrap_or(wo);
        let ng = if front.dot(wo) < 0.0 { -front } else { front };
        [ng, if t.material.unlit { ng } else { self.shading_normal(t, ng, wo) }]
    }

    /// The part of the light that stops at `hit`: alpha in [0, 1], 0 or 1 for masked materials, 1 for opaque ones.
    pub fn coverage(&self, hit: &Hit) -> f32 {
        let t = self.hit_triangle(hit);
        let m = t.material;
        if m.alpha == AlphaMode::Opaque {
            return 1.0;
        }
        let mut alpha = m.base_color.w;
        if !t.mesh.colors.is_empty() {
            alpha *= t.blend4(&t.mesh.colors).w;
        }
        if let Some(r) = &m.base_color_texture {
            alpha *= self.textures[r.texture as usize].sample_alpha(t.uv(r));
        }
        match m.alpha {
            AlphaMode::Mask(cutoff) => f32::from(alpha >= cutoff),
            _ => alpha.clamp(0.0, 1.0),
        }
    }

    /// Whether `hit` is on the side the winding calls the front, for a ray that goes along `dir`. Triangles without area
    /// have two fronts.
    pub fn is_front(&self, dir: Vec3, hit: &Hit) -> bool {
        let t = self.hit_triangle(hit);
        // A side is a sign: no length is needed where nothing is lost in single precision.
        if t.instance.identity {
            return t.winding().dot(dir.as_dvec3()) <= 0.0;
        }
        t.front().is_none_or(|front| front.dot(dir) <= 0.0)
    }

    /// Interpolated and bumped, on the side of `ng`, facing the viewer.
    fn shading_normal(&self, t: &Triangle<'_>, ng: Vec3, wo: Vec3) -> Vec3 {
        let flat = t.mesh.normals.is_empty();
        if flat && t.material.normal_texture.is_none() {
            return ng;
        }
        let to_world = |n: Vec3| {
            let n = if t.instance.identity { n } else { Vec3::from(t.instance.normal_matrix * Vec3A::from(n)) };
            n.try_normalize()
        };
        let smooth = if flat { t.front() } else { to_world(t.blend3(&t.mesh.normals)) };
        let mut n = smooth.unwrap_or(ng);
        // The side is the interpolated normal's: a bump must not turn the surface over.
        let turned = n.dot(ng) < 0.0;
        if let Some((texture, scale)) = &t.material.normal_texture
            && !t.mesh.tangents.is_empty()
        {
            n = self.bump(t, texture, *scale, n).unwrap_or(n);
        }
        if turned {
            n = -n;
        }
        let facing = n.dot(wo);
        if facing >= LEAST_COSINE {
            return n;
        }
        // Faces away from the viewer: turned until it just faces him. Black spots are what the alternative gives.
        let side = n - wo * facing;
        let sine = (1.0 - LEAST_COSINE * LEAST_COSINE).sqrt();
        side.try_normalize().map_or(ng, |s| s * sine + wo * LEAST_COSINE)
    }

    /// The normal map's normal about `n`: MikkTSpace's frame, the bitangent made from the interpolated vectors.
    fn bump(&self, t: &Triangle<'_>, texture: &TextureRef, scale: f32, n: Vec3) -> Option<Vec3> {
        let texel = self.textures[texture.texture as usize].sample(t.uv(texture));
        let tangent = t.blend4(&t.mesh.tangents);
        let along = tangent.truncate();
        let (along, sign) = if t.instance.identity {
            (along, tangent.w)
        } else {
            let sign = if t.instance.flipped { -tangent.w } else { tangent.w };
            (t.instance.transform.transform_vector3(along), sign)
        };
        // Made perpendicular: after skins, shears and interpolation it need not be.
        let along = (along - n * n.dot(along)).try_normalize()?;
        let across = n.cross(along) * if sign < 0.0 { -1.0 } else { 1.0 };
        let x = (2.0 * texel.x - 1.0) * scale;
        let y = (2.0 * texel.y - 1.0) * scale;
        let z = 2.0 * texel.z - 1.0;
        (along * x + across * y + n * z).try_normalize()
    }
}

/// Where a ray along `dir` starts so that it does not meet the surface it leaves. `position` and `error` are a
/// [`Surface`]'s, `n` its geometric normal (either side).
#[inline]
pub fn offset_origin(position: Vec3, error: f32, n: Vec3, dir: Vec3) -> Vec3 {
    let n = if n.dot(dir) < 0.0 { -n } else { n };
    let moved = position + n * error;
    // The addition rounds by half an ulp at most: one more ulp outwards in each coordinate makes up for it.
    let out = |p: f32, n: f32| match n {
        n if n > 0.0 => p.next_up(),
        n if n < 0.0 => p.next_down(),
        _ => p,
    };
    Vec3::new(out(moved.x, n.x), out(moved.y, n.y), out(moved.z, n.z))
}
