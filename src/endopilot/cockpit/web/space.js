// The 3-D view: translucent lumen, centerlines with the names of their sections, wire, catheters, target, believed wires.
import * as THREE from "three";
import { OrbitControls } from "./vendor/OrbitControls.js";
import { Tube } from "./tube.js";

const LUMEN_VERTEX = `
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    vec4 p = modelViewMatrix * vec4(position, 1.0);
    vNormal = normalMatrix * normal;
    vView = -p.xyz;
    gl_Position = projectionMatrix * p;
  }`;
const LUMEN_FRAGMENT = `
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    float facing = abs(dot(normalize(vNormal), normalize(vView)));
    float rim = pow(1.0 - facing, 2.0);
    gl_FragColor = vec4(mix(vec3(0.62, 0.32, 0.33), vec3(0.98, 0.72, 0.70), rim), 0.2 + 0.5 * rim);
  }`;
const PRESETS = { AP: [0, 0], "RAO 30": [-30, 0], "LAO 45": [45, 0], "LAO 45 CRAN 25": [45, 25], "RAO 30 CAUD 20": [-30, -20], lateral: [90, 0] };
const FIELD_DEG = 26;
const STILL_MM = 0.003;
const COARSE = 0.6; // resolution of a moving view that is drawn in software; a view at rest is sharp
const SHARP_AFTER_MS = 600; // longer than hands rest between two presses: drawing all pixels would delay the second
// The colours of sections in all pictures of endopilot; the two darkest are lighter here, on a dark ground.
const COLORS = ["#0f86d6", "#e69f00", "#12b886", "#e2703a", "#56b4e9", "#cc79a7", "#f0e442", "#a27fc6", "#b08a56", "#44aa99", "#c85a8e", "#9aa3b5"];
const sectionColor = (label) => COLORS[label % COLORS.length];

/** The scene in a canvas. `draw` is called once a frame. */
export class Space {
  constructor(canvas, scene, pick) {
    this.canvas = canvas;
    this.pick = pick;
    this.software = isSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.software, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(this.software ? 1 : Math.min(devicePixelRatio, 2));
    this.changedAt = -Infinity;
    this.renderer.setClearColor("#0d1424");
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight("#ffffff", "#566079", 2.6));
    this.camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 1, 5000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => { this.changed = true; });
    this.changed = true;
    this.wire = new Tube(scene.diameter_mm, scene.force_limit_n);
    this.catheters = (scene.catheters ?? []).map((one) => new Tube(one.diameter_mm, scene.force_limit_n, true));
    for (const tube of [this.wire, ...this.catheters]) this.scene.add(tube.mesh);
    this.addLumen(scene);
    this.addGuidingCatheter(scene);
    this.addCenterlines(scene);
    this.target = ring("#59c08b");
    this.scene.add(this.target);
    this.believed = new THREE.Group();
    this.scene.add(this.believed);
    this.look(0, 0);
    this.raycaster = new THREE.Raycaster();
    this.raycaster.params.Points.threshold = 2;
    canvas.addEventListener("dblclick", (event) => this.choose(event));
  }

  addLumen(scene) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(scene.vertices, 3));
    geometry.setIndex(new THREE.BufferAttribute(scene.triangles, 1));
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    const material = new THREE.ShaderMaterial({
      vertexShader: LUMEN_VERTEX, fragmentShader: LUMEN_FRAGMENT, transparent: true, depthWrite: false, side: THREE.FrontSide,
    });
    this.lumen = new THREE.Mesh(geometry, material);
    this.lumen.renderOrder = 3;
    this.scene.add(this.lumen);
    this.centre = geometry.boundingSphere.center.clone();
    this.size = geometry.boundingSphere.radius;
    this.controls.target.copy(this.centre);
  }

  /** Show the end of the guiding catheter, which holds the devices in the ostium and does not move. */
  addGuidingCatheter({ ostium, guiding_catheter: { direction, radius_mm } }) {
    const length = 25, radius = radius_mm + 0.25;
    const tube = new THREE.Mesh(
      new THREE.CylinderGeometry(radius, radius, length, 20, 1, true),
      new THREE.MeshLambertMaterial({ color: "#5f7396", transparent: true, opacity: 0.35, side: THREE.DoubleSide, depthWrite: false }),
    );
    const axis = new THREE.Vector3(...direction);
    tube.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), axis);
    tube.position.set(...ostium).addScaledVector(axis, -length / 2);
    tube.renderOrder = 2;
    this.scene.add(tube);
  }

  addCenterlines(scene) {
    this.places = { points: scene.points, labels: scene.labels, abscissa: scene.abscissa, branch: [] };
    const color = new Map(scene.sections.map((s) => [s.label, new THREE.Color(sectionColor(s.label))]));
    let begin = 0;
    scene.lines.forEach((count, branch) => {
      const colors = new Float32Array(3 * count);
      for (let i = 0; i < count; i++) {
        color.get(scene.labels[begin + i]).toArray(colors, 3 * i);
        this.places.branch.push(branch);
      }
      const line = new THREE.BufferGeometry();
      line.setAttribute("position", new THREE.BufferAttribute(scene.points.slice(3 * begin, 3 * (begin + count)), 3));
      line.setAttribute("color", new THREE.BufferAttribute(colors, 3));
      this.scene.add(new THREE.Line(line, new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.9 })));
      begin += count;
    });
    const cloud = new THREE.BufferGeometry();
    cloud.setAttribute("position", new THREE.BufferAttribute(scene.points, 3));
    this.cloud = new THREE.Points(cloud, new THREE.PointsMaterial({ visible: false }));
    this.scene.add(this.cloud);
    for (const section of scene.sections) {
      const at = [...scene.labels.keys()].filter((i) => scene.labels[i] === section.label);
      const middle = at[Math.floor(at.length / 2)];
      const label = text(section.name, sectionColor(section.label));
      label.position.fromArray(scene.points, 3 * middle);
      this.scene.add(label);
    }
  }

  /** Look as the C-arm does: LAO (positive) or RAO, and cranial (positive) or caudal, degrees. */
  look(lao, cranial) {
    const a = (lao * Math.PI) / 180, b = (cranial * Math.PI) / 180;
    const beam = new THREE.Vector3(Math.sin(a) * Math.cos(b), -Math.cos(a) * Math.cos(b), Math.sin(b));
    const distance = (1.03 * this.size) / Math.sin((FIELD_DEG / 2) * (Math.PI / 180));
    this.controls.target.copy(this.centre);
    this.camera.position.copy(this.centre).addScaledVector(beam, distance);
    this.camera.near = distance / 50;
    this.camera.far = 10 * distance;
    this.camera.updateProjectionMatrix();
    this.controls.update();
  }

  buttons(bar, currentAngles) {
    const add = (name, act) => {
      const button = document.createElement("button");
      button.textContent = name;
      button.onclick = act;
      bar.append(button);
    };
    for (const [name, angles] of Object.entries(PRESETS)) add(name, () => this.look(...angles));
    add("as C-arm", () => this.look(...currentAngles()));
    add("to the tip", () => {
      this.camera.position.add(this.wire.tip).sub(this.controls.target);
      this.controls.target.copy(this.wire.tip);
      this.controls.update();
    });
  }

  /** Show the state's wire, catheters and target. */
  show(state) {
    this.follow(this.wire, state.nodes, state.node_force);
    this.catheters.forEach((tube, k) => this.follow(tube, state[`catheter_${k + 1}_nodes`], state[`catheter_${k + 1}_force`]));
    const target = state.target?.position.join();
    if (target !== this.targetAt) {
      this.targetAt = target;
      this.target.visible = Boolean(target);
      if (target) this.target.position.set(...state.target.position);
      this.changed = true;
    }
  }

  /** Let a tube follow its nodes, if they have moved visibly since it was drawn. */
  follow(tube, nodes, force) {
    const before = tube.drawn;
    if (!nodes || (before?.length === nodes.length && nodes.every((value, i) => Math.abs(value - before[i]) < STILL_MM))) return;
    tube.drawn = nodes;
    tube.set(nodes, force);
    this.changed = true;
  }

  /** Show or hide what a policy believes. */
  believe(shown) {
    if (this.believed.visible !== shown) this.changed = true;
    this.believed.visible = shown;
  }

  /** Show the wires that a policy holds possible, the likeliest first, and its band along the centerline. */
  showBelief(belief) {
    this.changed = true;
    for (const old of this.believed.children) old.geometry.dispose();
    this.believed.clear();
    const each = belief.wires.length / Math.max(belief.wires_shown, 1);
    const add = (points, color, opacity, kind = THREE.Line) => {
      const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(points, 3));
      const paint = { color, transparent: true, opacity, depthTest: false };
      const line = new kind(geometry, kind === THREE.Points ? new THREE.PointsMaterial({ ...paint, size: 5, sizeAttenuation: false }) : new THREE.LineBasicMaterial(paint));
      line.frustumCulled = false;
      line.renderOrder = 4;
      this.believed.add(line);
    };
    for (let i = 0; i < belief.wires_shown; i++) add(belief.wires.slice(i * each, (i + 1) * each), "#6fc3ff", i ? 0.35 : 1);
    if (belief.band.length) add(belief.band.slice(), "#ffd34d", 0.8, THREE.Points);
  }

  /** Draw what has changed, and return whether there was anything to draw. */
  draw(now) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.width !== width || this.height !== height) {
      [this.width, this.height] = [width, height];
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / Math.max(height, 1);
      this.camera.updateProjectionMatrix();
      this.changed = true;
    }
    if (this.software) this.sharpen(now);
    if (!this.changed) return false;
    this.changed = false;
    this.target.quaternion.copy(this.camera.quaternion);
    this.renderer.render(this.scene, this.camera);
    return true;
  }

  /** Expect a motion: what is allotted for a moving view is allotted before it, not in the frame that shows it. */
  wake() {
    if (this.software) this.changed = true;
  }

  /** Draw a view that changes in fewer pixels, and once more in all of them when it is at rest. */
  sharpen(now) {
    if (this.changed) this.changedAt = now;
    const ratio = now - this.changedAt < SHARP_AFTER_MS ? COARSE : 1;
    if (ratio === this.renderer.getPixelRatio()) return;
    this.renderer.setPixelRatio(ratio);
    this.changed = true;
  }

  choose(event) {
    const box = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    this.raycaster.setFromCamera(at, this.camera);
    const hits = this.raycaster.intersectObject(this.cloud).sort((a, b) => a.distanceToRay - b.distanceToRay);
    if (hits.length) this.pick({ branch: this.places.branch[hits[0].index], abscissa: this.places.abscissa[hits[0].index] });
  }
}

function ring(color) {
  const geometry = new THREE.RingGeometry(2.2, 2.8, 32);
  const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color, side: THREE.DoubleSide, depthTest: false, transparent: true }));
  mesh.renderOrder = 5;
  return mesh;
}

function text(name, color) {
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d"), font = "600 30px system-ui, sans-serif";
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(name).width) + 12;
  canvas.height = 40;
  pen.font = font;
  pen.lineWidth = 6;
  pen.strokeStyle = "#0d1424";
  pen.fillStyle = color;
  pen.strokeText(name, 6, 30);
  pen.fillText(name, 6, 30);
  const material = new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), sizeAttenuation: false, depthTest: false });
  const sprite = new THREE.Sprite(material);
  sprite.scale.set((0.014 * canvas.width) / canvas.height, 0.014, 1);
  sprite.center.set(-0.3, 0.5);
  sprite.renderOrder = 6;
  return sprite;
}

function isSoftware() {
  const pen = document.createElement("canvas").getContext("webgl2");
  const info = pen?.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|software/i.test(info ? pen.getParameter(info.UNMASKED_RENDERER_WEBGL) : "");
}
