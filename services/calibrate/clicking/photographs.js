/** Handle the pointer on a canvas: a press that stays is a click, one that moves drags. Positions are canvas pixels. */
function follow(canvas, { click, drag, zoom }) {
  let from = null;
  let last = null;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top].map((value) => value * devicePixelRatio);
  };
  canvas.addEventListener("pointerdown", (event) => {
    from = last = place(event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (from === null) return;
    const here = place(event);
    if (last !== from || Math.hypot(here[0] - from[0], here[1] - from[1]) > STILL_PX * devicePixelRatio) {
      drag(here[0] - last[0], here[1] - last[1], event.shiftKey);
      last = here;
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    if (from !== null && last === from) click(place(event));
    from = null;
  });
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY / 500), place(event));
    },
    { passive: false },
  );
}

function fit(canvas) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((value) =>
    Math.round(value * devicePixelRatio),
  );
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return [width, height];
}

function ring(context, [x, y], name, isChosen) {
  const size = devicePixelRatio * (isChosen ? 8 : 5);
  for (const [colour, width] of [
    ["#000", 4],
    [isChosen ? "#ffd24d" : "#6db6ea", 2],
  ]) {
    context.strokeStyle = colour;
    context.lineWidth = width * devicePixelRatio;
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.stroke();
  }
  context.font = `${13 * devicePixelRatio}px system-ui, sans-serif`;
  context.lineWidth = 3 * devicePixelRatio;
  context.strokeStyle = "#000";
  context.fillStyle = "#fff";
  context.strokeText(name, x + 1.6 * size, y + 0.6 * size);
  context.fillText(name, x + 1.6 * size, y + 0.6 * size);
}

function rings(context, places) {
  landmarks.forEach((one, index) => {
    const place = places(one);
    if (place) ring(context, place, `${one.tooth} ${one.point}`, index === chosen);
  });
}

class PhotographView {
  constructor(canvas, { camera, size, jpeg }) {
    this.canvas = canvas;
    this.camera = camera;
    this.size = size;
    this.image = new Image();
    this.image.onload = () => this.draw();
    this.image.src = `data:image/jpeg;base64,${jpeg}`;
    /** Canvas pixels per camera pixel (null until first drawn), and the photograph's corner in canvas pixels. */
    this.scale = null;
    this.corner = [0, 0];
    follow(canvas, {
      click: (place) => {
        const xy = place.map((value, axis) => (value - this.corner[axis]) / this.scale);
        if (xy.every((value, axis) => value >= 0 && value <= this.size[axis])) {
          clicked((one) => one.pixels.set(this.camera, xy));
        }
      },
      drag: (dx, dy) => {
        this.corner = [this.corner[0] + dx, this.corner[1] + dy];
        this.draw();
      },
      zoom: (factor, place) => {
        this.corner = this.corner.map((value, axis) => place[axis] + factor * (value - place[axis]));
        this.scale *= factor;
        this.draw();
      },
    });
  }

  draw() {
    const [width, height] = fit(this.canvas);
    if (this.scale === null) {
      this.scale = Math.min(width / this.size[0], height / this.size[1]);
      this.corner = [(width - this.scale * this.size[0]) / 2, (height - this.scale * this.size[1]) / 2];
    }
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.drawImage(this.image, ...this.corner, ...this.size.map((value) => value * this.scale));
    rings(context, (one) => one.pixels.get(this.camera)?.map((value, axis) => this.corner[axis] + this.scale * value));
  }
}
