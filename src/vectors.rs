//! Vectors side by side, a row a component: vector units take many at a time.

use glam::Vec3;

/// A list of vectors.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Vectors {
    rows: [Vec<f32>; 3],
}

impl Vectors {
    /// How many there are.
    #[inline(always)]
    pub fn len(&self) -> usize {
        self.rows[0].len()
    }

    /// Whether there is none.
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        self.rows[0].is_empty()
    }

    /// The `i`-th; panics if there is none.
    #[inline(always)]
    pub fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.rows[0][i], self.rows[1][i], self.rows[2][i])
    }

    /// All of them.
    #[inline(always)]
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Vec3> + '_ {
        let [x, y, z] = &self.rows;
        x.iter().zip(y).zip(z).map(|((&x, &y), &z)| Vec3::new(x, y, z))
    }

    /// Their components.
    #[inline(always)]
    pub fn rows(&self) -> [&[f32]; 3] {
        let [x, y, z] = &self.rows;
        [x, y, z]
    }

    /// Adds one.
    #[inline(always)]
    pub fn push(&mut self, vector: Vec3) {
        for (row, component) in self.rows.iter_mut().zip(vector.to_array()) {
            row.push(component);
        }
    }

    /// Adds `count` zeros or takes all beyond `count` away; the components from `first` on.
    #[inline(always)]
    pub fn resize(&mut self, count: usize, first: usize) -> [&mut [f32]; 3] {
        let [x, y, z] = &mut self.rows;
        [x, y, z].map(|row| {
            row.resize(count, 0.0);
            &mut row[first..]
        })
    }

    /// Adds so many, given by their components.
    #[inline(always)]
    pub fn extend<const N: usize>(&mut self, rows: &[[f32; N]; 3]) {
        for (row, more) in self.rows.iter_mut().zip(rows) {
            row.extend_from_slice(more);
        }
    }

    /// Takes away all beyond `count`.
    #[inline(always)]
    pub fn truncate(&mut self, count: usize) {
        self.rows.iter_mut().for_each(|row| row.truncate(count));
    }

    /// Moves the vector at `from` to `to`.
    #[inline(always)]
    pub fn copy(&mut self, from: usize, to: usize) {
        for row in &mut self.rows {
            row[to] = row[from];
        }
    }

    /// Empties the list, keeping its memory.
    #[inline(always)]
    pub fn clear(&mut self) {
        self.rows.iter_mut().for_each(Vec::clear);
    }
}
