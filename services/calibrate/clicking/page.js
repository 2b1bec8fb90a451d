const content = JSON.parse(document.getElementById("content").textContent);
const landmarks = content.landmarks.map((one) => ({
  ...one,
  pixels: new Map(one.pixels.map((seen) => [seen.camera, seen.xy_px])),
}));
/** Largest movement of a press, in pixels of the screen, that still counts as a click. */
const STILL_PX = 4;
let chosen = landmarks.length - 1;
let isSaved = true;
const views = [];

function bytes(base64) {
  return Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
}

/** Begin a landmark by its tooth and point; if the list already has it, choose it again. */
document.getElementById("landmark").addEventListener("submit", (event) => {
  event.preventDefault();
  const tooth = Number(document.getElementById("tooth").value);
  const point = document.getElementById("point").value.trim();
  const known = landmarks.findIndex((one) => one.tooth === tooth && one.point === point);
  chosen = known >= 0 ? known : landmarks.push({ tooth, point, xyz_mm: null, pixels: new Map() }) - 1;
  show();
});

document.getElementById("save").addEventListener("click", () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([toml()], { type: "application/toml" }));
  link.download = "landmarks.toml";
  link.click();
  isSaved = true;
});

window.addEventListener("beforeunload", (event) => {
  if (!isSaved) event.preventDefault();
});

function toml() {
  const entries = landmarks.filter((one) => one.xyz_mm !== null);
  return entries
    .map((one) => {
      const seen = [...one.pixels].map(
        ([camera, [x, y]]) => `{camera = ${JSON.stringify(camera)}, xy_px = [${x.toFixed(1)}, ${y.toFixed(1)}]}`,
      );
      return [
        "[[landmark]]",
        `tooth = ${one.tooth}`,
        `point = ${JSON.stringify(one.point)}`,
        `xyz_mm = [${one.xyz_mm.map((value) => value.toFixed(3)).join(", ")}]`,
        `pixels = [${seen.join(", ")}]`,
        "",
      ].join("\n");
    })
    .join("\n");
}

function tell(sentence) {
  document.getElementById("told").textContent = sentence;
}

function show() {
  const one = landmarks[chosen];
  const missing = one ? (one.xyz_mm === null ? ["the scan"] : []) : [];
  for (const { camera } of one ? content.photographs : [])
    if (!one.pixels.has(camera)) missing.push(`camera ${camera}`);
  const state = missing.length ? `not clicked yet in ${missing.join(", ")}` : "clicked everywhere";
  tell(one ? `Now tooth ${one.tooth}, ${one.point}: ${state}.` : "Name a tooth and a point of it, and begin.");
  document.getElementById("rows").replaceChildren(...landmarks.map(row));
  document.getElementById("toml").textContent = toml();
  for (const view of views) view.draw();
}

function row(one, index) {
  const line = document.createElement("tr");
  line.classList.toggle("chosen", index === chosen);
  const head = document.createElement("th");
  head.scope = "row";
  head.textContent = one.tooth;
  const places = [one.xyz_mm, ...content.photographs.map(({ camera }) => one.pixels.get(camera))];
  const cells = [one.point, ...places.map((place) => place?.map((value) => value.toFixed(1)).join(", ") ?? "–")];
  const remove = document.createElement("button");
  remove.type = "button";
  remove.textContent = "Remove";
  remove.addEventListener("click", (event) => {
    event.stopPropagation();
    landmarks.splice(index, 1);
    chosen = Math.min(chosen, landmarks.length - 1);
    isSaved = false;
    show();
  });
  line.append(
    head,
    ...[...cells, remove].map((cell) => {
      const data = document.createElement("td");
      data.append(cell);
      return data;
    }),
  );
  line.addEventListener("click", () => {
    chosen = index;
    show();
  });
  return line;
}

function clicked(set) {
  if (!landmarks[chosen]) {
    document.getElementById("tooth").focus();
    return;
  }
  set(landmarks[chosen]);
  isSaved = false;
  show();
}

views.push(new ScanView(document.getElementById("surface"), document.getElementById("scan"), content.scan));
document.querySelectorAll("canvas.photograph").forEach((canvas, index) => {
  views.push(new PhotographView(canvas, content.photographs[index]));
});
window.addEventListener("resize", show);
show();
