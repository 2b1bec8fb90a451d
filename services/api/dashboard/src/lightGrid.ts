/** The lights of the dome as buttons. One of them is in the tab order; arrow keys, Home and End move to the others. */

import { element } from "./element";

export class LightGrid {
  readonly root = element("div", {
    class: "lights",
    role: "group",
    "aria-label": "Lights; arrow keys choose one, Enter lights it",
  });
  private lights: HTMLButtonElement[] = [];

  constructor(private readonly onLight: (light: number) => void) {
    this.root.addEventListener("keydown", (event) => this.move(event));
    this.root.addEventListener("focusin", (event) => this.reach(event.target as HTMLButtonElement));
  }

  /** Show `count` lights, and which of them emit. */
  show(count: number, lit: number[]): void {
    if (this.lights.length !== count) {
      this.lights = Array.from({ length: count }, (_, light) => this.button(light));
      this.root.replaceChildren(...this.lights);
    }
    this.lights.forEach((button, light) => button.setAttribute("aria-pressed", `${lit.includes(light)}`));
  }

  /** Show that it is not known which lights emit. The buttons stay, so that the focus does too. */
  forget(): void {
    for (const button of this.lights) button.removeAttribute("aria-pressed");
  }

  private button(light: number): HTMLButtonElement {
    const button = element(
      "button",
      { type: "button", "aria-label": `Light ${light}`, "aria-pressed": "false", tabindex: light ? "-1" : "0" },
      `${light}`,
    );
    button.addEventListener("click", () => this.onLight(light));
    return button;
  }

  private reach(button: HTMLButtonElement): void {
    for (const light of this.lights) light.tabIndex = light === button ? 0 : -1;
  }

  private move(event: KeyboardEvent): void {
    const now = this.lights.indexOf(event.target as HTMLButtonElement);
    const last = this.lights.length - 1;
    const top = this.lights[0]?.offsetTop;
    const columns = this.lights.filter((light) => light.offsetTop === top).length;
    const steps: Record<string, number> = {
      ArrowLeft: now - 1,
      ArrowRight: now + 1,
      ArrowUp: now - columns,
      ArrowDown: now + columns,
      Home: 0,
      End: last,
    };
    const next = steps[event.key];
    if (next === undefined) return;
    event.preventDefault();
    if (next >= 0 && next <= last) this.lights[next]?.focus();
  }
}
