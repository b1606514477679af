"use strict";
/* Camera models: rays to pixels and back, with what is valid. The formulas, their names and their sources are those of
 * camtorch/optics and camtorch/models; tests/viewer holds them to Python. Rays are [x, y, z], pixels [u, v], both null
 * where there is none. Nothing here knows of a page, so that other programs may take this file as it is.
 */
const Formulas = (() => {
  const FAR = 1e9; // focal lengths that no image has, and whose ninth power is still a number
  const FURTHEST = Math.tan((87 * Math.PI) / 180); // up to there the inverted charts have rays, in focal lengths
  const EPS = 2 ** -52;
  const AZIMUTHS = 336;
  const HALF_TURN = Math.PI * (1 - EPS);

  const hypot = (a, b) => Math.sqrt(a * a + b * b); // numbers here are far from overflowing

  const unit = (x, y, z) => {
    const length = Math.sqrt(x * x + y * y + z * z);
    return [x / length, y / length, z / length];
  };

  // -- radial factors: `image(r)` is the distorted radius s and ds/dr; `margin(r)` is positive where it is defined

  function polynomialOf(coefficients, power) {
    // 1 + c0 x^power + c1 x^(2 power) + ..., and its derivative
    return (x) => {
      const t = power === 2 ? x * x : x;
      let value = 0, slope = 0;
      for (let i = coefficients.length - 1; i >= 0; i--) {
        slope = slope * t + (i + 1) * coefficients[i];
        value = (value + coefficients[i]) * t;
      }
      return [1 + value, power === 2 ? 2 * x * slope : slope];
    };
  }

  const everywhere = () => 1;

  function factor(of, margin = everywhere) {
    const image = (r) => {
      const [value, slope] = of(r);
      return [r * value, value + r * slope];
    };
    return { image, margin };
  }

  const polynomial = (k) => factor(polynomialOf(k, 2));
  const radiusPolynomial = (k) => factor(polynomialOf(k, 1));

  function rational(above, below) {
    const numerator = polynomialOf(above, 2), denominator = polynomialOf(below, 2);
    return factor(
      (r) => {
        const [n, dn] = numerator(r), [d, dd] = denominator(r);
        return [n / d, (dn - (n / d) * dd) / d];
      },
      (r) => denominator(r)[0],
    );
  }

  function angleOf(ahead) {
    // the angle of the ray (r, 0, D)
    const image = (r) => {
      const [d, slope] = ahead(r);
      return [Math.atan2(r, d), (d - r * slope) / (r * r + d * d)];
    };
    return { image, margin: everywhere };
  }

  function radiusTable(nodes, values) {
    const x = [0, ...nodes], y = [0, ...values], last = x.length - 1;
    const steps = nodes.map((_, i) => x[i + 1] - x[i]), secants = nodes.map((_, i) => (y[i + 1] - y[i]) / steps[i]);
    const slopes = splineSlopes(steps, secants);
    let end = last;
    while (secants.slice(0, end).some((s) => !(s > 0))) end--;
    const image = (r) => {
      if (r > x[last]) return [y[last], -1];
      let i = 0;
      while (i < last - 1 && r >= x[i + 1]) i++;
      const h = steps[i], d = r - x[i], before = slopes[i], after = slopes[i + 1];
      const square = (3 * secants[i] - 2 * before - after) / h, cube = (before + after - 2 * secants[i]) / (h * h);
      return [y[i] + d * (before + d * (square + d * cube)), before + d * (2 * square + 3 * d * cube)];
    };
    return { image, margin: everywhere, fold: x[end] };
  }

  function splineSlopes(steps, secants) {
    // two continuous derivatives, odd at the origin, the last two pieces one polynomial; then Hyman's filter
    const n = steps.length, before = steps[n - 2], after = steps[n - 1], both = before + after;
    const main = [2], above = [1], below = [0], right = [3 * secants[0]];
    for (let i = 1; i < n; i++) {
      main.push(2 * (steps[i - 1] + steps[i]));
      above.push(steps[i - 1]);
      below.push(steps[i]);
      right.push(3 * (steps[i] * secants[i - 1] + steps[i - 1] * secants[i]));
    }
    main.push(before);
    below.push(both);
    right.push((after * after * secants[n - 2] + (2 * both + after) * before * secants[n - 1]) / both);
    for (let i = 1; i <= n; i++) {
      const part = below[i] / main[i - 1];
      main[i] -= part * above[i - 1];
      right[i] -= part * right[i - 1];
    }
    const slopes = [];
    for (let i = n; i >= 0; i--) slopes[i] = (right[i] - (i < n ? above[i] * slopes[i + 1] : 0)) / main[i];
    return slopes.map((slope, i) => {
      const one = secants[Math.max(i - 1, 0)], other = secants[Math.min(i, n - 1)];
      if (i > 0 && i < n && one * other <= 0) return 0;
      const sign = Math.sign(one), least = Math.min(Math.abs(one), Math.abs(other));
      return sign * Math.min(Math.max(slope * sign, 0.25 * least), 2.5 * least);
    });
  }

  function bisected(good, low, high) {
    // the last number between a good one and one that is not
    for (let i = 0; i < 60 && low < high; i++) {
      const middle = (low + high) / 2;
      if (good(middle)) low = middle;
      else high = middle;
    }
    return low;
  }

  function firstLoss(orientation, radii) {
    // up to where a function is positive on ascending radii, also between them; the last radius if it always is
    const values = radii.map(orientation);
    const good = (r) => orientation(r) > 0;
    for (let i = 0; i < radii.length; i++) {
      if (!(values[i] > 0)) return i ? bisected(good, radii[i - 1], radii[i]) : 0;
      if (i < 2) continue;
      const bend = values[i - 2] - 2 * values[i - 1] + values[i], tilt = values[i - 2] - values[i];
      if (bend > 0 && Math.abs(tilt) <= bend && values[i - 1] - (tilt * tilt) / (4 * bend) <= 0) {
        for (let j = 1; j <= 64; j++) {
          const r = radii[i - 2] + ((radii[i] - radii[i - 2]) * j) / 64;
          if (!good(r)) return bisected(good, radii[i - 2], r);
        }
      }
    }
    return radii[radii.length - 1];
  }

  const orientationOf = (radial) => (r) => {
    const [s, slope] = radial.image(r);
    return Math.min(r > 0 ? s / r : slope, slope, radial.margin(r));
  };

  function ascending(radial, radii) {
    // where the distorted radius ceases to ascend, and the inverse up to there
    const end = radii[radii.length - 1];
    const fold = radial.fold === undefined ? firstLoss(orientationOf(radial), radii) : Math.min(radial.fold, end);
    const nodes = [...radii.filter((r) => r < fold), fold], images = nodes.map((r) => radial.image(r)[0]);
    const most = images[images.length - 1];
    const inverse = (s) => {
      if (!(s <= most)) return null;
      let low = 0, high = nodes.length - 1;
      while (high - low > 1) {
        const middle = (low + high) >> 1;
        if (images[middle] <= s) low = middle;
        else high = middle;
      }
      let a = nodes[low], b = nodes[high];
      let r = a + ((b - a) * (s - images[low])) / (images[high] - images[low] || 1);
      for (let i = 0; i < 60; i++) {
        const [value, slope] = radial.image(r);
        if (value > s) b = r;
        else a = r;
        let next = r - (value - s) / slope;
        if (!(next >= a && next <= b)) next = (a + b) / 2;
        if (Math.abs(next - r) <= 4 * EPS * r) return next;
        r = next;
      }
      return r;
    };
    return { fold, most, inverse };
  }

  // -- charts: a ray, its largest component near 1, to a point of a plane, and back; null for what is not covered

  function radiiOf(count, stepsTo, end, bend = (x) => x) {
    // half in even steps, half in even ratios: a telephoto lens may fold within a degree
    const half = count >> 1, radii = [];
    for (let i = 0; i < half; i++) radii.push(bend((stepsTo * i) / (half - 1)));
    for (let i = 0; i < count - half; i++) radii.push(1e-4 * (end / 1e-4) ** (i / (count - half - 1)));
    return radii.map((r) => Math.min(r, end)).sort((a, b) => a - b);
  }

  const perspectiveRadii = (end) => (count) =>
    end < 2 ? radiiOf(count, end, end) : radiiOf(count, (88 * Math.PI) / 180, end, Math.tan);

  const perspective = () => ({
    end: FAR,
    radii: perspectiveRadii(FAR),
    to: (x, y, z) => (FAR * z > Math.max(Math.abs(x), Math.abs(y)) ? [x / z, y / z] : null),
    back: (a, b) => (Math.max(Math.abs(a), Math.abs(b)) < FAR ? unit(a, b, 1) : null),
  });

  const equidistant = (end = Math.PI) => ({
    end: Math.min(end, Math.PI),
    radii: (count) => radiiOf(count, Math.min(end, Math.PI), Math.min(end, Math.PI)),
    to: (x, y, z) => {
      const rho = hypot(x, y);
      if (!(z > 0 || rho > 1e-140)) return null;
      const scale = rho > 0 ? Math.atan2(rho, z) / rho : 1 / z;
      return [x * scale, y * scale];
    },
    back: (a, b) => {
      const theta = hypot(a, b);
      if (!(theta < Math.PI)) return null;
      const scale = theta > 0 ? Math.sin(theta) / theta : 1;
      return [a * scale, b * scale, Math.cos(theta)];
    },
  });

  const sumOf = (z, root, difference) => (z > 0 ? z + root : difference / (root - z)); // without cancellation

  const equisolid = () => {
    const end = 2 * (1 - 64 * EPS);
    return {
      end,
      radii: (count) => radiiOf(count, end, end),
      to: (x, y, z) => {
        const rho2 = x * x + y * y, distance = Math.sqrt(rho2 + z * z);
        if (!(z > 0 || rho2 > 0)) return null;
        const scale = Math.sqrt(2 / (distance * sumOf(z, distance, rho2)));
        return [x * scale, y * scale];
      },
      back: (a, b) => {
        const r2 = a * a + b * b;
        if (!(r2 < end * end)) return null;
        const across = Math.sqrt(1 - r2 / 4);
        return [a * across, b * across, 1 - r2 / 2];
      },
    };
  };

  const fov = (omega) => {
    const slope = omega ? (2 * Math.tan(omega / 2)) / omega : 1, tangent = omega * slope;
    return {
      end: FAR,
      to: (x, y, z) => {
        const rho = hypot(x, y);
        if (!tangent) return perspective().to(x, y, z);
        if (!(FAR * z > Math.max(Math.abs(x), Math.abs(y)) || rho > 1e-140)) return null;
        const scale = rho > 0 ? Math.atan2(Math.abs(tangent) * rho, z) / (Math.abs(omega) * rho) : slope / z;
        return [x * scale, y * scale];
      },
      back: (a, b) => {
        const angle = Math.abs(omega) * hypot(a, b);
        if (!(angle < Math.PI && Math.max(Math.abs(a), Math.abs(b)) < FAR / 2)) return null;
        const scale = (angle > 0 ? Math.sin(angle) / angle : 1) / slope;
        return unit(a * scale, b * scale, Math.cos(angle));
      },
    };
  };

  const oneDivision = (k) => ({
    end: FAR,
    to: (x, y, z) => {
      const difference = -4 * k * (x * x + y * y), square = difference + z * z;
      if (!(square > 0)) return null;
      const below = sumOf(z, Math.sqrt(square), difference);
      if (!((FAR / 2) * below > Math.max(Math.abs(x), Math.abs(y)))) return null;
      return [(2 * x) / below, (2 * y) / below];
    },
    back: (a, b) => {
      const r2 = a * a + b * b;
      if (!(k * r2 < 1 - 64 * EPS && Math.max(Math.abs(a), Math.abs(b)) < FAR / 2)) return null;
      return unit(a, b, 1 + k * r2);
    },
  });

  const unified = ({ xi = 0, alpha = 0, beta = 1 }) => {
    // (x, y) / (alpha d' + (1 - alpha) z'), d' = sqrt(beta rho^2 + z'^2), z' = z + xi d
    const shifted = xi !== 0;
    let end = FAR / 2;
    if (!shifted && alpha > 0.5) end = Math.min(end, (1 - 64 * EPS) / Math.sqrt(2 * alpha - 1));
    if (xi * xi > 1) end = Math.min(end, (1 - 64 * EPS) / Math.sqrt(xi * xi - 1));
    const below = (rho2, z, sphere) => {
      if (alpha === 0) return z;
      if (z > 0) return z + alpha * (sphere - z);
      const above = alpha * alpha * beta * rho2 + (2 * alpha - 1) * z * z;
      return above / (alpha * sphere - (1 - alpha) * z);
    };
    return {
      end,
      radii: perspectiveRadii(end),
      to: (x, y, z) => {
        const rho2 = x * x + y * y, distance = Math.sqrt(rho2 + z * z);
        const behind = z + xi * distance, sphere = Math.sqrt(beta * rho2 + behind * behind);
        const under = below(rho2, behind, sphere);
        const good = Math.min(
          FAR * under - Math.max(Math.abs(x), Math.abs(y)),
          alpha * behind + (1 - alpha) * sphere,
          shifted ? distance + xi * z : 1,
        );
        return good > 0 ? [x / under, y / under] : null;
      },
      back: (a, b) => {
        const rho2 = a * a + b * b, around = beta * rho2, twice = 2 * alpha - 1;
        const inside = 1 - 64 * EPS - twice * around;
        if (!(inside > 0 && Math.max(Math.abs(a), Math.abs(b)) < FAR / 2)) return null;
        const root = Math.sqrt(1 - twice * around);
        // two forms of one function: the first one divides by zero at 1/2, the second one may far from there
        const ahead =
          Math.abs(twice) > 0.5
            ? (alpha - 1 + alpha * root) / twice
            : (1 - alpha * alpha * around) / (1 - alpha + alpha * root);
        if (!shifted) return unit(a, b, ahead);
        const before = ahead * ahead + (1 - xi) * (1 + xi) * rho2;
        if (!(before - 64 * EPS * (rho2 + ahead * ahead) > 0)) return null;
        const reach = Math.sqrt(before) + xi * ahead;
        if (!(reach - 64 * EPS * Math.abs(ahead) > 0)) return null;
        const scale = reach / (rho2 + ahead * ahead);
        return [a * scale, b * scale, ahead * scale - xi];
      },
    };
  };

  const inverted = (radial) => {
    // the point of radius r sees the angle s(r)
    const radii = (count) => radiiOf(count, FURTHEST, FURTHEST);
    const { fold, most, inverse } = ascending(radial, radii(2048));
    const end = most > Math.PI ? inverse(Math.PI * (1 - 32 * EPS)) : fold;
    const plain = equidistant();
    return {
      end,
      radii,
      to: (x, y, z) => {
        const point = plain.to(x, y, z), theta = point ? hypot(point[0], point[1]) : 0;
        if (!point || !(theta < most * (1 - 16 * EPS))) return null;
        const scale = theta > 0 ? inverse(theta) / theta : 1;
        return [point[0] * scale, point[1] * scale];
      },
      back: (a, b) => {
        const r = hypot(a, b), theta = radial.image(r)[0];
        if (!(r < fold * (1 - 32 * EPS) && theta < Math.min(most, Math.PI))) return null;
        return r > 0 ? plain.back((a * theta) / r, (b * theta) / r) : [0, 0, 1];
      },
    };
  };

  const cylinder = () => ({
    end: Infinity,
    panorama: [Math.PI, FAR],
    to: (x, y, z) => {
      const across = hypot(x, z);
      return FAR * across > Math.abs(y) ? [Math.atan2(x, z), y / across] : null;
    },
    back: (a, b) => (Math.abs(a) < HALF_TURN && Math.abs(b) < FAR ? unit(Math.sin(a), b, Math.cos(a)) : null),
  });

  const sphere = () => ({
    end: Infinity,
    panorama: [Math.PI, Math.PI / 2],
    to: (x, y, z) => {
      const across = hypot(x, z);
      return across > 1e-140 ? [Math.atan2(x, z), Math.atan2(y, across)] : null;
    },
    back: (a, b) =>
      Math.abs(a) < HALF_TURN && Math.abs(b) < Math.PI / 2
        ? [Math.sin(a) * Math.cos(b), Math.sin(b), Math.cos(a) * Math.cos(b)]
        : null,
  });

  const transverse = (chart) => ({
    end: chart.end,
    panorama: [...chart.panorama].reverse(),
    to: (x, y, z) => chart.to(y, x, z)?.reverse() ?? null,
    back: (a, b) => {
      const ray = chart.back(b, a);
      return ray && [ray[1], ray[0], ray[2]];
    },
  });

  // -- stages of a lens: `at(a, b)` is [u, v, du/da, du/db, dv/da, dv/db, margin]; `start` a point near what gives (u, v)

  function planar({ radial = null, tangential = [0, 0], prism = [0, 0, 0, 0] }) {
    const [px, py] = tangential, [s0, s1 = 0, s2 = 0, s3 = 0] = prism;
    const at = (a, b) => {
      const t = a * a + b * b, r = Math.sqrt(t), dot = 2 * (px * a + py * b);
      let R = 1, bend = 0, margin = 1;
      if (radial) {
        const [s, slope] = radial.image(r);
        R = r > 1e-12 ? s / r : slope;
        bend = r > 1e-12 ? (slope - R) / t : 0;
        margin = radial.margin(r);
      }
      const gx = 2 * px + 2 * s0 + 4 * s1 * t, gy = 2 * py + 2 * s2 + 4 * s3 * t;
      return [
        a * R + a * dot + t * (px + s0 + s1 * t),
        b * R + b * dot + t * (py + s2 + s3 * t),
        R + bend * a * a + dot + 2 * px * a + gx * a,
        bend * a * b + 2 * py * a + gx * b,
        bend * a * b + 2 * px * b + gy * a,
        R + bend * b * b + dot + 2 * py * b + gy * b,
        margin,
      ];
    };
    const isRadial = ![...tangential, ...prism].some((w) => w !== 0);
    const start = (u, v) => {
      const [x, y] = at(u, v);
      return [2 * u - x, 2 * v - y];
    };
    return { at, start, radial, isRadial: isRadial && radial !== null, isIdentity: isRadial && radial === null };
  }

  function homography(matrix) {
    // row by row: (a, b, 1) becomes (x, y, w), and the point x / w, y / w
    const [h00, h01, h02, h10, h11, h12, h20, h21, h22] = matrix;
    const at = (a, b) => {
      const depth = h20 * a + h21 * b + h22, u = (h00 * a + h01 * b + h02) / depth, v = (h10 * a + h11 * b + h12) / depth;
      const [ua, ub, va, vb] = [h00 - u * h20, h01 - u * h21, h10 - v * h20, h11 - v * h21].map((w) => w / depth);
      return [u, v, ua, ub, va, vb, depth];
    };
    const start = (u, v) => {
      const below = (h10 * h21 - h11 * h20) * u + (h01 * h20 - h00 * h21) * v + h00 * h11 - h01 * h10;
      return [
        ((h11 * h22 - h12 * h21) * u + (h02 * h21 - h01 * h22) * v + h01 * h12 - h02 * h11) / below,
        ((h12 * h20 - h10 * h22) * u + (h00 * h22 - h02 * h20) * v + h02 * h10 - h00 * h12) / below,
      ];
    };
    return { at, start, isIdentity: matrix.every((w, i) => w === (i % 4 ? 0 : 1)) };
  }

  function tilt(x, y) {
    // a sensor turned by R = R_y(y) R_x(x) and projected back along the axis
    const cx = Math.cos(x), sx = Math.sin(x), cy = Math.cos(y), sy = Math.sin(y);
    return homography([cx, 0, 0, -sx * sy, cy, 0, sy, -cy * sx, cy * cx]);
  }

  const shear = (d, e) => ({
    at: (a, b) => [a + e * b, b + d * a, 1, e, d, 1, 1],
    start: (u, v) => [(u - e * v) / (1 - d * e), (v - d * u) / (1 - d * e)],
    isIdentity: d === 0 && e === 0,
  });

  function surface(controls, { columns, rows, order }, cells) {
    // a uniform B-spline surface that is added to the plane; control point (i, j) at controls[2 (j columns + i)]
    const sizes = [columns, rows], half = sizes.map((size) => (size - order) / 2);
    const weights = (x) => {
      if (order === 2)
        return [[(4 * x - 4) * x + 1, 6 - 8 * x * x, (4 * x + 4) * x + 1].map((w) => w / 8), [x - 0.5, -2 * x, x + 0.5]];
      const y = 1 - x;
      return [
        [y * y * y, (3 * x - 6) * x * x + 4, ((3 - 3 * x) * x + 3) * x + 1, x * x * x].map((w) => w / 6),
        [-y * y / 2, (3 * x - 4) * x / 2, (1 + (2 - 3 * x) * x) / 2, x * x / 2],
      ];
    };
    const place = (w, axis) => {
      const position = w * cells + (sizes[axis] - 1) / 2;
      const cell = Math.min(Math.max(Math.floor(position + (order === 2 ? 0.5 : 0)), 1), sizes[axis] - order);
      return [cell - 1, ...weights(position - cell)];
    };
    const at = (a, b) => {
      const [i, along, byA] = place(a, 0), [j, down, byB] = place(b, 1), sums = [0, 0, 0, 0, 0, 0];
      for (let y = 0; y <= order; y++)
        for (let x = 0; x <= order; x++) {
          const from = 2 * ((j + y) * columns + i + x);
          [along[x] * down[y], byA[x] * down[y] * cells, along[x] * byB[y] * cells].forEach((w, which) => {
            sums[2 * which] += w * controls[from];
            sums[2 * which + 1] += w * controls[from + 1];
          });
        }
      const [u, v, ua, va, ub, vb] = sums;
      // a little behind the edge, so that what lies on it is on it in any rounding
      const margin = Math.min(half[0] + 1e-4 - Math.abs(a * cells), half[1] + 1e-4 - Math.abs(b * cells));
      return [a + u, b + v, 1 + ua, ub, va, 1 + vb, margin];
    };
    const start = (u, v) => {
      let [a, b] = [u, v];
      for (let i = 0; i < 3; i++) {
        [a, b] = [a, b].map((w, axis) => Math.min(Math.max(w, -half[axis] / cells), half[axis] / cells));
        const [x, y] = at(a, b);
        [a, b] = [a + u - x, b + v - y];
      }
      return [a, b];
    };
    return { at, start, isIdentity: false };
  }

  function splined(k, text = "order=3,columns=10,rows=8,fov_x=160") {
    const grid = Object.fromEntries(text.split(",").map((part) => part.split("=")).map(([name, value]) => [name, Number(value)]));
    const { columns, rows, order, fov_x: width } = grid, edge = 2 * Math.tan((width * Math.PI) / 720);
    const cells = (columns - order) / (2 * edge), end = hypot(edge, (rows - order) / 2 / cells) * (1 + 1e-3);
    if (k.length !== 2 * columns * rows) throw new Error(`A surface of ${columns} x ${rows} control points has two numbers of each.`);
    return [{ ...unified({ alpha: 0.5 }), end, radii: (count) => radiiOf(count, end, end) }, surface(k, grid, cells)];
  }

  function lensAt(stages, a, b) {
    // as a stage's, with the orientation, positive where all of it is regular, in place of the margin
    let u = a, v = b, ua = 1, ub = 0, va = 0, vb = 1, orientation = Infinity;
    for (const stage of stages) {
      const [p, q, pa, pb, qa, qb, margin] = stage.at(u, v);
      orientation = Math.min(orientation, pa * qb - pb * qa, pa + qb, margin);
      [u, v, ua, ub, va, vb] = [p, q, pa * ua + pb * va, pa * ub + pb * vb, qa * ua + qb * va, qa * ub + qb * vb];
    }
    return [u, v, ua, ub, va, vb, Number.isNaN(orientation) ? -1 : orientation];
  }

  // -- where a lens is one-to-one, and its inverse

  function radialLens(stage, chart) {
    const { fold, inverse } = ascending(stage.radial, chart.radii(2048));
    const end = Math.min(fold, chart.end);
    return {
      end: () => end,
      contains: (a, b) => hypot(a, b) < end * (1 - 4 * EPS),
      to: (a, b) => stage.at(a, b),
      back: (u, v) => {
        const s = hypot(u, v), r = inverse(s);
        if (r === null || !(r < end * (1 - 16 * EPS))) return null;
        return s > 0 ? [(u * r) / s, (v * r) / s] : [0, 0];
      },
    };
  }

  function generalLens(stages, chart) {
    const radial = stages[0].radial, usual = radial && ascending(radial, chart.radii(512));
    // dense around the fold of the radial factor, where such a lens mostly folds
    const around = usual && usual.fold < chart.end ? usual.fold : 1;
    const close = Array.from({ length: 40 }, (_, i) => around * (1 + 0.5 * (i / 19.5 - 1) ** 3));
    const radii = [...chart.radii(40), ...close].map((r) => Math.min(r, chart.end)).sort((p, q) => p - q);
    const lost = new Float64Array(AZIMUTHS), limits = new Float64Array(AZIMUTHS);
    for (let i = 0; i < AZIMUTHS; i++) {
      const c = Math.cos((2 * Math.PI * i) / AZIMUTHS), s = Math.sin((2 * Math.PI * i) / AZIMUTHS);
      lost[i] = firstLoss((r) => lensAt(stages, r * c, r * s)[6], radii);
    }
    for (let i = 0; i < AZIMUTHS; i++) {
      // between two azimuths the fold moves smoothly, and may bulge, or it ends there
      const pair = [lost[i], lost[(i + 1) % AZIMUTHS]], nearer = Math.min(...pair), further = Math.max(...pair);
      limits[i] = further <= 1.1 * nearer ? Math.min(1.001 * further, chart.end) : nearer;
    }
    const sector = (a, b) => ((Math.atan2(b, a) / (2 * Math.PI) + 1) * AZIMUTHS) % AZIMUTHS;
    const contains = (a, b, orientation) =>
      hypot(a, b) < limits[Math.floor(sector(a, b)) % AZIMUTHS] && orientation > 0;

    const newton = (u, v, a, b) => {
      // each step is shortened until the next one by the same Jacobian is shorter, and it stays inside
      let at = lensAt(stages, a, b), length = 1;
      if (!contains(a, b, at[6])) return null;
      for (let i = 0; i < 60; i++) {
        const [x, y, ua, ub, va, vb] = at, determinant = ua * vb - ub * va;
        const solve = (p, q) => [(vb * p - ub * q) / determinant, (ua * q - va * p) / determinant];
        const [da, db] = solve(u - x, v - y), size = hypot(da, db);
        if (size <= 8 * EPS * (0.01 + hypot(a, b))) return [a, b];
        const trial = lensAt(stages, a + length * da, b + length * db);
        const nearer = Math.hypot(...solve(u - trial[0], v - trial[1])) < size;
        if (nearer && contains(a + length * da, b + length * db, trial[6])) {
          [a, b] = [a + length * da, b + length * db];
          [at, length] = [trial, Math.min(1, 4 * length)];
        } else if ((length /= 4) < 1e-9) break;
      }
      return hypot(at[0] - u, at[1] - v) <= 1e-9 * (1 + hypot(u, v)) ? [a, b] : null;
    };

    // the image of the rim, by direction: beyond the furthest of it there is nothing to look for
    let furthest = 0, open = false;
    for (let i = 0; i < AZIMUTHS; i++) {
      const r = lost[i] * (1 - 1e-9), turn = (2 * Math.PI * i) / AZIMUTHS;
      furthest = Math.max(furthest, Math.hypot(...lensAt(stages, r * Math.cos(turn), r * Math.sin(turn)).slice(0, 2)));
      open = open || !Number.isFinite(furthest);
    }

    const back = (u, v) => {
      if (!open && hypot(u, v) > 1.01 * furthest) return null;
      let [a, b] = [u, v];
      for (const stage of [...stages.slice(1)].reverse()) [a, b] = stage.start(a, b);
      if (usual) {
        const s = hypot(a, b), r = usual.inverse(Math.min(s, usual.most));
        if (s > 0) [a, b] = [(a * r) / s, (b * r) / s];
      } else [a, b] = stages[0].start(a, b);
      const first = newton(u, v, a, b);
      if (first) return first;
      // from before the fold, on azimuths beside that of the start
      for (let turn = 0; turn < 9; turn++) {
        const angle = Math.atan2(b, a) + ((turn % 2 ? -1 : 1) * ((turn + 1) >> 1) * Math.PI) / 9;
        const [c, s] = [Math.cos(angle), Math.sin(angle)];
        const limit = Math.min(lost[Math.round(sector(c, s)) % AZIMUTHS], 50);
        for (const part of [0.97, 0.6]) {
          const found = newton(u, v, part * limit * c, part * limit * s);
          if (found) return found;
        }
      }
      return null;
    };
    return {
      end: (angle) => lost[Math.round(sector(Math.cos(angle), Math.sin(angle))) % AZIMUTHS],
      contains: (a, b) => contains(a, b, lensAt(stages, a, b)[6]),
      to: (a, b) => lensAt(stages, a, b),
      back,
    };
  }

  // -- the models: coefficients to a chart and the stages after it

  const fisheye = (chart) => (k) => [chart(), planar({ radial: polynomial(k) })];
  const aria = (k) => [
    equidistant(),
    planar({ radial: polynomial(k.slice(0, 6)) }),
    planar({ tangential: k.slice(6, 8), prism: k.length > 8 ? k.slice(8) : undefined }),
  ];
  const fTheta = (k) => [equidistant(), planar({ radial: radiusPolynomial(k) })];

  const MODELS = {
    pinhole: () => [perspective()],
    brown_conrady: ([k1, k2, p1, p2, ...more]) => {
      const above = [k1, k2, ...more.slice(0, 1)];
      const radial = more.length > 1 ? rational(above, more.slice(1, 4)) : polynomial(above);
      const prism = more.length > 4 ? more.slice(4, 8) : undefined;
      const stages = [planar({ radial, tangential: [p2, p1], prism })]; // p2 is the one along x
      return [perspective(), ...stages, ...(more.length > 8 ? [tilt(...more.slice(8))] : [])];
    },
    kannala_brandt: fisheye(equidistant),
    equisolid: fisheye(equisolid),
    stereographic: fisheye(() => unified({ alpha: 0.5 })),
    orthographic_fisheye: fisheye(() => unified({ alpha: 1 })),
    fisheye62: aria,
    fisheye624: aria,
    thin_prism_fisheye: ([k1, k2, p1, p2, k3, k4, sx1, sy1]) => [
      equidistant(),
      planar({ radial: polynomial([k1, k2, k3, k4]), tangential: [p2, p1], prism: [sx1, 0, sy1, 0] }),
    ],
    f_theta: fTheta,
    f_theta_sheared: ([d, e, ...k]) => [...fTheta(k), shear(d, e)],
    woodscape: fTheta,
    f_theta_backward: (k) => [inverted(radiusPolynomial(k))],
    f_theta_backward_sheared: ([d, e, ...k]) => [inverted(radiusPolynomial(k)), shear(d, e)],
    ocamcalib: ([d, e, ...a]) => [inverted(angleOf(polynomialOf(a, 1))), shear(d, e)],
    division: (k) => [k.length === 1 ? oneDivision(k[0]) : inverted(angleOf(polynomialOf(k, 2)))],
    fov: ([omega]) => [fov(omega)],
    ucm: ([alpha]) => [unified({ alpha })],
    eucm: ([alpha, beta]) => [unified({ alpha, beta })],
    double_sphere: ([xi, alpha]) => [unified({ xi, alpha })],
    mei: ([xi, k1, k2, p1, p2]) => [unified({ xi }), planar({ radial: polynomial([k1, k2]), tangential: [p2, p1] })],
    tabulated: (k) => {
      const angles = k.slice(0, k.length / 2);
      return [
        equidistant(angles[angles.length - 1]),
        planar({ radial: radiusTable(angles, k.slice(k.length / 2)) }),
      ];
    },
    splined,
    equirectangular: () => [sphere()],
    latlon: () => [transverse(sphere())],
    cylindrical: () => [cylinder()],
    transverse_cylindrical: () => [transverse(cylinder())],
  };

  // what formulas need beside numbers that are finite, and how to say it
  const DEFINED = {
    eucm: (k) => k[1] > 0 || "beta must be above 0",
    double_sphere: (k) => k[0] > -1 || "xi must be above -1",
    mei: (k) => k[0] > -1 || "xi must be above -1",
    fov: (k) => Math.abs(k[0]) < Math.PI || "omega must lie between -pi and pi",
    tabulated: (k) =>
      k.slice(0, k.length / 2).every((angle, i) => angle > (i ? k[i - 1] : 0)) || "the angles must ascend from above 0",
  };

  function partsOf(model) {
    // "splined:order=3,..." has a grid
    const [family, ...variants] = model.split(":"), most = family === "splined" ? 1 : 0;
    if (!Object.hasOwn(MODELS, family) || variants.length > most) throw new Error(`This page has no formulas of the model ${model}.`);
    return { family, grid: variants[0] };
  }

  /** A camera: its model's key, [fx, fy, cx, cy] in pixels, coefficients. Throws an Error that says what is wrong. */
  class Camera {
    constructor(model, intrinsics, distortion = []) {
      const { family, grid } = partsOf(model);
      const [fx, fy] = intrinsics;
      if (intrinsics.length !== 4 || ![...intrinsics, ...distortion].every(Number.isFinite))
        throw new Error("All numbers of a camera must be finite.");
      if (!(fx > 0 && fy > 0)) throw new Error("Focal lengths must be above 0.");
      const defined = DEFINED[family]?.(distortion) ?? true;
      if (defined !== true) throw new Error(`No camera has such coefficients: ${defined}.`);
      Object.assign(this, { model, intrinsics, distortion });
      const [chart, ...stages] = MODELS[family](distortion, grid);
      this.chart = chart;
      const some = stages.filter((stage) => !stage.isIdentity);
      if (!some.length) this.lens = null;
      else if (some.length === 1 && some[0].isRadial) this.lens = radialLens(some[0], chart);
      else this.lens = generalLens(some, chart);
    }

    /** The pixel of a direction of any length. */
    project(x, y, z) {
      const size = Math.max(Math.abs(x), Math.abs(y), Math.abs(z));
      if (!(size > 1e-150 && size < Infinity)) return null;
      const point = this.chart.to(x / size, y / size, z / size);
      if (!point) return null;
      let [a, b] = point;
      if (this.lens) {
        if (!this.lens.contains(a, b)) return null;
        [a, b] = this.lens.to(a, b);
      }
      const [fx, fy, cx, cy] = this.intrinsics;
      return [fx * a + cx, fy * b + cy];
    }

    /** The ray of length 1 that a pixel sees. */
    unproject(u, v) {
      const [fx, fy, cx, cy] = this.intrinsics;
      let [a, b] = [(u - cx) / fx, (v - cy) / fy];
      if (this.lens) {
        const found = this.lens.back(a, b);
        if (!found) return null;
        [a, b] = found;
      }
      const ray = this.chart.back(a, b);
      // next to a fold the solution may lie on its other side: what counts is where its ray is seen
      return ray && (!this.lens || this.project(...ray)) ? ray : null;
    }

    /** The outline of the pixels that have rays, in pixels; what lies far off is drawn in. */
    rim(count = 240) {
      const [fx, fy, cx, cy] = this.intrinsics, far = 1e5;
      const near = (w) => Math.min(Math.max(w, -far), far);
      const pixel = (a, b) => [near(fx * a + cx), near(fy * b + cy)];
      if (this.chart.panorama) {
        const [a, b] = this.chart.panorama;
        return [[-a, -b], [a, -b], [a, b], [-a, b]].map((corner) => pixel(...corner));
      }
      return Array.from({ length: count }, (_, i) => {
        const angle = (2 * Math.PI * i) / count, c = Math.cos(angle), s = Math.sin(angle);
        const end = this.edge(c, s);
        const [a, b] = this.lens ? this.lens.to(end * c, end * s) : [end * c, end * s];
        return pixel(a, b);
      });
    }

    /** The radius on the chart's plane, in this direction of it, at which the camera ends. */
    edge(c, s) {
      const chart = this.chart;
      const end = Math.min(this.lens ? this.lens.end(Math.atan2(s, c)) : Infinity, chart.end, 1e6) * (1 - 1e-7);
      const good = (r) => chart.back(r * c, r * s) !== null;
      return good(end) ? end : bisected(good, 0, end);
    }

    /** The angle from the axis, in radians, up to which a direction around the axis is seen. */
    reach(azimuth) {
      const c = Math.cos(azimuth), s = Math.sin(azimuth);
      const seen = (theta) => this.project(Math.sin(theta) * c, Math.sin(theta) * s, Math.cos(theta)) !== null;
      for (let i = 1; i <= 180; i++)
        if (!seen((Math.PI * i) / 180)) return bisected(seen, (Math.PI * (i - 1)) / 180, (Math.PI * i) / 180);
      return Math.PI;
    }
  }

  return { Camera, MODELS: Object.keys(MODELS), partsOf };
})();
if (typeof module !== "undefined") module.exports = Formulas;
