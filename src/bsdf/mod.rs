//! How a surface reflects: glTF's metallic-roughness model (Appendix B of its specification).

use glam::Vec3;

/// A resolved reflectance: all textures looked up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bsdf {
    /// Albedo of the diffuse lobe, Fresnel not counted.
    pub diffuse: Vec3,
    /// The specular lobe; `None` for a Lambertian surface.
    pub specular: Option<Specular>,
}

/// A GGX lobe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Specular {
    /// GGX width α = roughness².
    pub alpha: f32,
    /// Reflectance at normal incidence.
    pub f0: Vec3,
    /// Reflectance at grazing incidence.
    pub f90: Vec3,
}
