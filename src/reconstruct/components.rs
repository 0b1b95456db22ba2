//! Connected components of a mask.

use crate::image::Plane;

/// Components of a mask: `label` holds 0 outside and 1.. inside, `area` the pixels of each label (entry 0
/// unused).
#[derive(Debug)]
pub struct Components {
    /// Label of each pixel.
    pub label: Plane<u32>,
    /// Pixels of each label.
    pub area: Vec<u32>,
}

/// Labels the 8-connected components of the non-zero pixels, in the order of their first pixel.
pub fn label(mask: &Plane<u8>) -> Components {
    let (width, height) = (mask.width(), mask.height());
    let mut label = Plane::filled(width, height, 0u32);
    let mut parent: Vec<u32> = vec![0];
    for v in 0..height {
        for u in 0..width {
            if mask.at(u, v) == 0 {
                continue;
            }
            let mut own = 0;
            let above = v.checked_sub(1);
            let neighbours = [
                u.checked_sub(1).map(|x| (x, v)),
                above.and_then(|y| u.checked_sub(1).map(|x| (x, y))),
                above.map(|y| (u, y)),
                above.and_then(|y| (u + 1 < width).then_some((u + 1, y))),
            ];
            for (x, y) in neighbours.into_iter().flatten() {
                let other = label.at(x, y);
                if other != 0 && other != own {
                    own = if own == 0 { other } else { join(&mut parent, own, other) };
                }
            }
            if own == 0 {
                own = parent.len() as u32;
                parent.push(own);
            }
            label.set(u, v, own);
        }
    }
    compact(label, &mut parent)
}

fn find(parent: &mut [u32], mut x: u32) -> u32 {
    while parent[x as usize] != x {
        parent[x as usize] = parent[parent[x as usize] as usize];
        x = parent[x as usize];
    }
    x
}

/// Joins two labels; the smaller root stays.
fn join(parent: &mut [u32], a: u32, b: u32) -> u32 {
    let (a, b) = (find(parent, a), find(parent, b));
    let (low, high) = (a.min(b), a.max(b));
    parent[high as usize] = low;
    low
}

fn compact(mut label: Plane<u32>, parent: &mut [u32]) -> Components {
    let mut number = vec![0u32; parent.len()];
    let mut area = vec![0u32];
    for x in label.as_mut_slice() {
        if *x == 0 {
            continue;
        }
        let root = find(parent, *x) as usize;
        if number[root] == 0 {
            number[root] = area.len() as u32;
            area.push(0);
        }
        *x = number[root];
        area[*x as usize] += 1;
    }
    Components { label, area }
}

#[cfg(test)]
mod tests {
    use super::label;
    use crate::image::Plane;

    #[test]
    fn a_ring_is_one_component_and_its_hole_is_not_labelled() {
        let text = ["..##..#", ".#..#.#", ".#..#..", "..##..#"];
        let data = text.iter().flat_map(|row| row.bytes().map(|b| u8::from(b == b'#'))).collect();
        let found = label(&Plane::from_vec(7, 4, data).expect("28 pixels"));
        assert_eq!(found.area, [0, 8, 2, 1]);
        assert_eq!(found.label.at(2, 1), 0);
    }
}
