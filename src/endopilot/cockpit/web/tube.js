// The wire and each catheter as a tube of its true diameter, coloured by the wall's force.
import * as THREE from "three";

const SIDES = 8;
const PIECES = 2; // of a wire between two nodes; a catheter, which bends less, has one
const MOST = 1600; // rings

const COLD = new THREE.Color("#f6f7fb");
const CATHETER = new THREE.Color("#19b5c8"); // where no wall presses on a catheter
const CATHETER_OPACITY = 0.6; // the wire is seen in it
const WARM = new THREE.Color("#ffd34d");
const HOT = new THREE.Color("#ff2d1a");

/** A wire or a catheter, whose rings follow the nodes that `set` is given; a catheter is seen through. */
export class Tube {
  constructor(diameter, forceScale, isCatheter = false) {
    this.cold = isCatheter ? CATHETER : COLD;
    this.pieces = isCatheter ? 1 : PIECES;
    this.radius = diameter / 2;
    this.forceScale = forceScale;
    this.position = new Float32Array(MOST * SIDES * 3);
    this.normal = new Float32Array(MOST * SIDES * 3);
    this.color = new Float32Array(MOST * SIDES * 3);
    const index = [];
    for (let ring = 0; ring + 1 < MOST; ring++) {
      for (let side = 0; side < SIDES; side++) {
        const a = ring * SIDES + side, b = ring * SIDES + ((side + 1) % SIDES);
        index.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
      }
    }
    const geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      geometry.setAttribute(name, new THREE.BufferAttribute(this[name], 3).setUsage(THREE.DynamicDrawUsage));
    }
    geometry.setIndex(index);
    geometry.setDrawRange(0, 0);
    // the faces of a tube look inwards
    const seen = isCatheter ? { transparent: true, opacity: CATHETER_OPACITY, side: THREE.BackSide } : { side: THREE.DoubleSide };
    this.mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ vertexColors: true, ...seen }));
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = isCatheter ? 2 : 1;
    this.tip = new THREE.Vector3();
  }

  /** Show the tube with these nodes (x, y, z one after the other), tip first, and the force of the wall at each. */
  set(nodes, force) {
    const count = nodes.length / 3;
    const point = (i) => new THREE.Vector3(nodes[3 * i], nodes[3 * i + 1], nodes[3 * i + 2]);
    const points = Array.from({ length: count }, (_, i) => point(i));
    if (count < 2) return;
    this.tip.copy(points[0]);
    const rings = Math.min((count - 1) * this.pieces + 1, MOST);
    const up = new THREE.Vector3(), side = new THREE.Vector3(), tangent = new THREE.Vector3(), at = new THREE.Vector3();
    tangent.subVectors(points[1], points[0]).normalize();
    up.set(0, 0, 1);
    if (Math.abs(tangent.z) > 0.9) up.set(1, 0, 0);
    for (let ring = 0; ring < rings; ring++) {
      const whole = Math.min(Math.floor(ring / this.pieces), count - 2), share = ring / this.pieces - whole;
      catmullRom(points, whole, share, at, tangent);
      side.crossVectors(tangent, up).normalize();
      up.crossVectors(side, tangent).normalize();
      const color = forceColor((force[whole] * (1 - share) + force[whole + 1] * share) / this.forceScale, this.cold);
      for (let k = 0; k < SIDES; k++) {
        const angle = (2 * Math.PI * k) / SIDES, c = Math.cos(angle), s = Math.sin(angle), to = 3 * (ring * SIDES + k);
        for (const [axis, name] of [[0, "x"], [1, "y"], [2, "z"]]) {
          const out = c * side[name] + s * up[name];
          this.normal[to + axis] = out;
          this.position[to + axis] = at[name] + this.radius * out;
        }
        this.color[to] = color.r;
        this.color[to + 1] = color.g;
        this.color[to + 2] = color.b;
      }
    }
    const geometry = this.mesh.geometry;
    for (const name of ["position", "normal", "color"]) {
      const attribute = geometry.getAttribute(name);
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, rings * SIDES * 3);
      attribute.needsUpdate = true;
    }
    geometry.setDrawRange(0, (rings - 1) * SIDES * 6);
  }
}

/** Return the colour of a force, given as a share of the largest that is safe; `cold` is that of none. */
function forceColor(share, cold) {
  const color = new THREE.Color();
  return share < 0.5 ? color.lerpColors(cold, WARM, Math.max(0, 2 * share)) : color.lerpColors(WARM, HOT, Math.min(1, 2 * share - 1));
}

function catmullRom(points, whole, t, at, tangent) {
  const last = points.length - 1;
  const [a, b, c, d] = [-1, 0, 1, 2].map((k) => points[Math.min(Math.max(whole + k, 0), last)]);
  for (const x of ["x", "y", "z"]) {
    const m = (c[x] - a[x]) / 2, n = (d[x] - b[x]) / 2, p = b[x], q = c[x];
    const cubic = 2 * p - 2 * q + m + n, square = 3 * q - 3 * p - 2 * m - n;
    at[x] = ((cubic * t + square) * t + m) * t + p;
    tangent[x] = (3 * cubic * t + 2 * square) * t + m;
  }
  if (tangent.lengthSq() < 1e-12) tangent.subVectors(c, b);
  tangent.normalize();
}
