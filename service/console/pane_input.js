// Mouse, wheel, touch and keys on a picture of the scene.

const STEP = 60; // pixels that an arrow key pans
const CLICK = 4; // pixels that the pointer may move in a click

/**
 * Let people move the view and choose agents.
 * @param {import("./scene_canvas.js").SceneCanvas} canvas
 * @param {{moved: () => void, choose: (left: number, top: number) => void, hover: (left: number, top: number) => void}} on
 *   moved: after the view was moved by hand.
 */
export function listenToPane(canvas, on) {
  const { pane, view } = canvas;
  const surface = pane.querySelector(".agent-layer");
  const pointers = new Map();
  let travelled = 0;
  const place = (event) => {
    const box = pane.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  surface.addEventListener("pointerdown", (event) => {
    surface.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    travelled = 0;
  });
  surface.addEventListener("pointermove", (event) => {
    const [left, top] = place(event);
    const before = pointers.get(event.pointerId);
    if (!before) {
      on.hover(left, top);
      return;
    }
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    if (others.length) {
      const [x, y] = others[0];
      const [was, is] = [Math.hypot(before[0] - x, before[1] - y), Math.hypot(left - x, top - y)];
      if (was > 0 && is > 0) view.zoom(is / was, x, y, canvas.size);
    } else {
      travelled += Math.hypot(left - before[0], top - before[1]);
      if (travelled > CLICK) view.pan(left - before[0], top - before[1]);
    }
    pointers.set(event.pointerId, [left, top]);
    if (travelled > CLICK || others.length) on.moved();
  });
  surface.addEventListener("pointerup", (event) => {
    if (pointers.delete(event.pointerId) && travelled <= CLICK && pointers.size === 0) on.choose(...place(event));
  });
  surface.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
  surface.addEventListener("pointerleave", () => on.hover(-1e6, -1e6));
  surface.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event), canvas.size);
      on.moved("zoom");
    },
    { passive: false },
  );
  surface.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [STEP, 0], ArrowRight: [-STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] }[event.key];
    if (!step) return;
    event.preventDefault();
    view.pan(...step);
    on.moved();
  });
}
