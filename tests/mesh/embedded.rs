//! Whether triangles between points of whole numbers cross one another, in whole numbers: nothing is rounded.

pub type Point = [i128; 3];

fn minus(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: Point, b: Point) -> Point {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn dot(a: Point, b: Point) -> i128 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Whether a segment has a point in common with a triangle.
fn meets([p, q]: [Point; 2], triangle: [Point; 3]) -> bool {
    let [a, b, c] = triangle;
    let n = cross(minus(b, a), minus(c, a));
    let (from, to) = (dot(n, minus(p, a)), dot(n, minus(q, a)));
    if from.signum() * to.signum() > 0 {
        return false;
    }
    let edges = [(a, b), (b, c), (c, a)];
    if from == 0 && to == 0 {
        let holds = |x: Point| {
            let sides = edges.map(|(u, v)| dot(n, cross(minus(v, u), minus(x, u))));
            sides.iter().all(|s| *s >= 0)
        };
        let side = |u: Point, v: Point, x: Point| dot(n, cross(minus(v, u), minus(x, u))).signum();
        let between = |u: Point, v: Point, x: Point| {
            (0..3).all(|k| u[k].min(v[k]) <= x[k] && x[k] <= u[k].max(v[k]))
        };
        let meet = |(u, v): (Point, Point)| {
            let s = [side(u, v, p), side(u, v, q), side(p, q, u), side(p, q, v)];
            if s == [0; 4] {
                [u, v].iter().any(|x| between(p, q, *x)) || [p, q].iter().any(|x| between(u, v, *x))
            } else {
                s[0] * s[1] <= 0 && s[2] * s[3] <= 0
            }
        };
        return holds(p) || holds(q) || edges.into_iter().any(meet);
    }
    // Where the line pierces the plane, times a positive number.
    let scale = from - to;
    let at = [0, 1, 2].map(|k| p[k] * scale + (q[k] - p[k]) * from);
    let times = |x: Point| x.map(|x| x * scale);
    let sides = edges.map(|(u, v)| {
        let out = cross(minus(v, u), minus(at, times(u)));
        dot(n, out) * scale.signum()
    });
    sides.iter().all(|s| *s >= 0)
}

/// Whether two triangles have more in common than equal corners, or the edge between two.
pub fn cross_one_another(s: [Point; 3], t: [Point; 3]) -> bool {
    let own: Vec<usize> = (0..3).filter(|k| !t.contains(&s[*k])).collect();
    let other: Vec<usize> = (0..3).filter(|k| !s.contains(&t[*k])).collect();
    let edge = |t: [Point; 3], opposite: usize| [t[(opposite + 1) % 3], t[(opposite + 2) % 3]];
    match own.len() {
        3 => (0..3).any(|k| meets(edge(s, k), t) || meets(edge(t, k), s)),
        2 => {
            let at = |free: &[usize]| (0..3).find(|k| !free.contains(k)).unwrap_or(0);
            meets(edge(s, at(&own)), t) || meets(edge(t, at(&other)), s)
        }
        1 => {
            let [u, v] = edge(s, own[0]);
            let n = cross(minus(v, u), minus(s[own[0]], u));
            let way = minus(t[other[0]], u);
            dot(n, way) == 0 && dot(n, cross(minus(v, u), way)) > 0
        }
        _ => true,
    }
}
