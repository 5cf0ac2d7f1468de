//! Randomness as a pure function of what it is for: (seed, pixel, sample, dimension). No state is carried, so an image
//! does not depend on threads or tiles.

/// Mixes a 32-bit word (the "lowbias32" finaliser found by Chris Wellons' hash prospector).
#[inline(always)]
pub fn mix(mut x: u32) -> u32 {
    x ^= x >> 16;
    x = x.wrapping_mul(0x21f0_aaad);
    x ^= x >> 15;
    x = x.wrapping_mul(0x735a_2d97);
    x ^ (x >> 15)
}

/// Combines a hash with one more word.
#[inline(always)]
pub fn combine(hash: u32, word: u32) -> u32 {
    mix(hash.wrapping_mul(0x9e37_79b9) ^ word.wrapping_add(0x6d2b_79f5))
}

/// A hash of several words.
#[inline(always)]
pub fn hash(words: &[u32]) -> u32 {
    words.iter().fold(0x2545_f491, |h, &w| combine(h, w))
}

/// Uniform in [0, 1) with 24 bits, from the top of a word.
#[inline(always)]
pub fn unit(word: u32) -> f32 {
    (word >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Owen scrambling of a 32-bit fraction by a hash (Laine & Karras 2011, constants from Vegdahl 2021): every binary
/// digit is flipped by a function of the digits above it.
#[inline(always)]
pub fn owen(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits();
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^= x.wrapping_mul(0x53a2_2864);
    x.reverse_bits()
}

/// The first two dimensions of Sobol's sequence at `index`, Owen-scrambled by `seed`; 32-bit fractions.
#[inline(always)]
pub fn sobol2(index: u32, seed: u32) -> [u32; 2] {
    // A nested scramble of the index permutes within every aligned power-of-two block: each stays a (0, m, 2)-net.
    let index = owen(index, combine(seed, 2));
    let (x, y) = (index.reverse_bits(), second_dimension(index));
    [owen(x, combine(seed, 0)), owen(y, combine(seed, 1))]
}

/// Sobol's second generator matrix is Pascal's triangle modulo 2, a Kronecker power: its product takes five steps.
#[inline(always)]
fn second_dimension(index: u32) -> u32 {
    let mut y = index;
    y ^= (y & 0xaaaa_aaaa) >> 1;
    y ^= (y & 0xcccc_cccc) >> 2;
    y ^= (y & 0xf0f0_f0f0) >> 4;
    y ^= (y & 0xff00_ff00) >> 8;
    y ^= y >> 16;
    y.reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_dimension_follows_its_direction_numbers() {
        for index in (0..10_000).map(|i| if i < 100 { i } else { mix(i) }) {
            let (mut expected, mut direction) = (0, 1u32 << 31);
            for bit in 0..32 {
                expected ^= if index >> bit & 1 == 1 { direction } else { 0 };
                direction ^= direction >> 1;
            }
            assert_eq!(second_dimension(index), expected, "{index}");
        }
    }

    #[test]
    fn aligned_blocks_of_the_sequence_are_nets() {
        for seed in 0..20 {
            for block in 0..4 {
                for shape in 0..5 {
                    // 16 points: one in each of the 16 boxes of 2^shape × 2^(4−shape).
                    let mut seen = [0; 16];
                    for i in 0..16 {
                        let [x, y] = sobol2(block * 16 + i, seed);
                        let cell = (u64::from(x) >> (32 - shape)) << (4 - shape) | u64::from(y) >> (28 + shape);
                        seen[cell as usize] += 1;
                    }
                    assert_eq!(seen, [1; 16], "seed {seed} block {block} shape {shape}");
                }
            }
        }
    }

    #[test]
    fn words_are_uniform() {
        let mean = (0..100_000u32).map(|i| f64::from(unit(hash(&[7, i])))).sum::<f64>() / 1e5;
        assert!((mean - 0.5).abs() < 4.0 * (1.0f64 / 12.0 / 1e5).sqrt(), "{mean}");
    }
}
