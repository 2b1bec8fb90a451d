/**
 * The dome by hand: ALL OFF, the state of the controller, one light for alignment, preflight. The controller is asked
 * again every second.
 */

import {
  allOff,
  darken,
  type DomeState,
  type DomeStatus,
  getDome,
  keepOffConnection,
  lightUp,
  preflight,
  sentenceOf,
  type Session,
  Unauthenticated,
} from "./api";
import { element } from "./element";
import { LightGrid } from "./lightGrid";

const ASK_AGAIN_MS = 1000;
/** Pause in ms between requests that keep the connection for ALL OFF open; servers close an idle one after 5 s. */
const KEEP_OPEN_MS = 2000;
/** Age in ms beyond which the last state of the dome is shown as unknown. */
const STALE_MS = 3000;
/** Time in ms after which the page says that ALL OFF has had no answer. */
const OFF_PATIENCE_MS = 1000;
const EMERGENCY = "Press the dome's emergency stop, or cut its power.";
const LONGEST_LIGHT_S = 30;

export class DomeView {
  readonly root = element("article", { class: "dome" });
  private readonly state = element("span", { class: "badge", role: "status" });
  private readonly heard = element("span", { class: "heard soft" });
  private readonly address = element("span", { class: "soft" });
  private readonly off = element("button", { type: "button", class: "all-off" }, "ALL OFF");
  private readonly offTrouble = element("p", { class: "failure off-trouble", role: "alert" });
  private readonly done = element("p", { class: "done", role: "status" });
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  private readonly noAnswer = element("p", { class: "failure", role: "alert" });
  private readonly facts = element("dl", { class: "facts" });
  private readonly capturing = element("p", { class: "soft" });
  private readonly level = numberInput("level", 5, 1, 100);
  private readonly seconds = numberInput("seconds", 10, 1, LONGEST_LIGHT_S);
  private readonly dark = element("button", { type: "button" }, "Switch it off");
  private readonly grid = new LightGrid((light) => void this.light(light));
  private readonly mouth = element("input", {
    id: "mouth",
    type: "text",
    required: "",
    spellcheck: "false",
    autocomplete: "off",
  });
  private readonly look = element("button", {}, "Run the preflight");
  private readonly findings = element("ul", { class: "findings", role: "status" });
  private capturers = "";
  private actionCount = 0;
  private timer = 0;
  private keeper = 0;
  private clock = 0;
  /** When the dome last reported its state (`performance.now()`, ms), and that state in words. */
  private heardMs: number | null = null;
  private lastState = "";
  private isStopped = false;

  constructor(
    private readonly onConnection: (open: boolean) => void,
    private readonly session: () => Session | null,
  ) {
    this.offTrouble.hidden = true;
    this.refusal.hidden = true;
    this.noAnswer.hidden = true;
    this.capturing.hidden = true;
    this.off.addEventListener("click", () => void this.allOff());
    this.dark.addEventListener("click", () => void this.act(async () => this.hear(await darken())));
  }

  /** Fill the view, ALL OFF first of all, and follow the dome until `stop`. */
  start(): void {
    const rig = element(
      "form",
      { class: "fields" },
      labelled("Folder of the rig on the server", this.mouth),
      this.look,
    );
    rig.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.preflight();
    });
    this.root.replaceChildren(
      element("header", {}, element("h2", {}, "Dome"), this.state, this.heard, this.address),
      this.off,
      this.offTrouble,
      element(
        "p",
        { class: "soft" },
        "Every light goes dark at once and every capture is stopped. It is no emergency stop: that one is a switch.",
      ),
      this.done,
      this.refusal,
      this.noAnswer,
      section("One light, for alignment", this.capturing, this.fields(), this.grid.root),
      section(
        "Preflight",
        element("p", { class: "soft" }, "Every light for a moment, black level and clipping; takes seconds."),
        rig,
        this.findings,
      ),
      section("Controller", this.facts),
    );
    this.clock = window.setInterval(() => this.showAge(), 500);
    void this.askAgain();
    void this.keepOpen();
  }

  stop(): void {
    this.isStopped = true;
    window.clearTimeout(this.timer);
    window.clearTimeout(this.keeper);
    window.clearInterval(this.clock);
  }

  private fields(): HTMLElement {
    return element(
      "div",
      { class: "fields" },
      labelled("Level, %", this.level),
      labelled(`Seconds, ${LONGEST_LIGHT_S} at most`, this.seconds),
      this.dark,
    );
  }

  private async allOff(): Promise<void> {
    this.offTrouble.hidden = true;
    const late = window.setTimeout(() => {
      this.offTrouble.textContent =
        `ALL OFF has had no answer for ${OFF_PATIENCE_MS / 1000} s; it is still being sent. ` + EMERGENCY;
      this.offTrouble.hidden = false;
    }, OFF_PATIENCE_MS);
    try {
      await this.act(async () => {
        const { status, stopped, others_stopped: others } = await allOff(this.session());
        this.hear(status);
        const names = [...stopped, ...(others ? [ofOthers(others)] : [])];
        const ended = names.length ? `Stopped: ${names.join(", ")}.` : "No job was capturing.";
        this.done.textContent = `All is dark. ${ended}`;
      });
      if (!this.refusal.hidden)
        this.refusal.textContent = `ALL OFF was not carried out: ${this.refusal.textContent} ${EMERGENCY}`;
    } finally {
      window.clearTimeout(late);
      this.offTrouble.hidden = true;
    }
  }

  private async light(light: number): Promise<void> {
    for (const input of [this.level, this.seconds]) if (!input.reportValidity()) return;
    await this.act(async () =>
      this.hear(await lightUp(light, this.level.valueAsNumber / 100, this.seconds.valueAsNumber)),
    );
  }

  private async preflight(): Promise<void> {
    this.look.disabled = true;
    this.findings.replaceChildren(element("li", {}, "The dome is being looked at."));
    let found: string[] = [];
    await this.act(async () => {
      const { findings } = await preflight(this.mouth.value.trim());
      found = findings.length ? findings : ["All is well."];
    });
    this.findings.replaceChildren(...found.map((finding) => element("li", {}, finding)));
    this.look.disabled = false;
  }

  /** Carry out an action by hand. If it is refused the reason is shown; messages of earlier actions are removed. */
  private async act(action: () => Promise<void>): Promise<void> {
    this.refusal.hidden = true;
    this.done.textContent = "";
    try {
      await action();
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      showProblem(this.refusal, problem);
    } finally {
      this.actionCount += 1;
    }
  }

  private askLater(): void {
    if (this.isStopped) return;
    this.timer = window.setTimeout(() => void this.askAgain(), ASK_AGAIN_MS);
  }

  private async askAgain(): Promise<void> {
    const actionCount = this.actionCount;
    try {
      const dome = document.hidden ? null : await getDome();
      if (this.isStopped) return;
      // An answer from before the last action is out of date.
      if (dome && actionCount === this.actionCount) this.take(dome);
      this.onConnection(true);
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      if (this.isStopped) return;
      const isLost = problem instanceof TypeError;
      this.onConnection(!isLost);
      // After a timeout the state stays until it is too old (showAge).
      if (!(problem instanceof DOMException)) this.forget();
      showProblem(this.noAnswer, problem);
      this.noAnswer.hidden = isLost || problem instanceof DOMException;
    }
    this.askLater();
  }

  private async keepOpen(): Promise<void> {
    if (!document.hidden) await keepOffConnection();
    if (!this.isStopped) this.keeper = window.setTimeout(() => void this.keepOpen(), KEEP_OPEN_MS);
  }

  /** Show the state as unknown. */
  private forget(): void {
    this.state.textContent = "unknown";
    this.state.dataset["state"] = "FAILED";
    this.done.textContent = "";
    this.grid.forget();
    this.facts.replaceChildren();
  }

  /** Show how long ago the dome was last heard; a state that is too old is shown as past and not as present. */
  private showAge(): void {
    if (this.heardMs === null) {
      this.heard.textContent = "not heard yet";
      return;
    }
    const ageMs = performance.now() - this.heardMs;
    const isStale = ageMs > STALE_MS;
    const state = isStale && this.lastState ? `: ${this.lastState}` : "";
    this.heard.textContent = `last heard ${Math.floor(ageMs / 1000)} s ago${state}`;
    this.heard.classList.toggle("stale", isStale);
    if (isStale && this.state.textContent !== "unknown") this.forget();
  }

  private hear(status: DomeStatus): void {
    this.heardMs = performance.now();
    this.show(status);
    this.lastState = this.state.textContent ?? "";
    this.showAge();
  }

  private take(dome: DomeState): void {
    this.noAnswer.hidden = true;
    this.hear(dome.status);
    this.address.textContent = dome.address;
    const capturers = [...dome.capturing, dome.others_capturing].join();
    this.capturing.hidden = dome.capturing.length + dome.others_capturing === 0;
    if (this.capturers === capturers) return;
    this.capturers = capturers;
    const links = dome.capturing.flatMap((id) => [" ", element("a", { href: `#/${id}` }, id)]);
    const others = dome.others_capturing ? [links.length ? " and " : " ", ofOthers(dome.others_capturing)] : [];
    this.capturing.replaceChildren(
      "The dome captures, so no light goes on by hand.",
      ...(links.length ? [" Job", ...links] : []),
      ...others,
      ".",
    );
  }

  private show(status: DomeStatus): void {
    const [first] = status.lit;
    this.state.textContent =
      first === undefined
        ? status.stopped
          ? "dark, ALL OFF"
          : "dark"
        : status.lit.length === 1
          ? `light ${first} is on`
          : `${status.lit.length} lights are on`;
    this.state.dataset["state"] = first === undefined ? "SUCCEEDED" : "RUNNING";
    if (first !== undefined) this.done.textContent = "";
    this.grid.show(status.light_count, status.lit);
    const rows: [string, string][] = [
      ["Lights", `${status.light_count}`],
      ["Interlock", status.interlock_closed ? "closed" : "open"],
      ["Emergency stop", status.emergency_stop ? "pressed" : "not pressed"],
      ["LED supply", status.supply_on ? "on" : "off"],
      ["ALL OFF", status.stopped ? "holds until somebody starts anew" : "does not hold"],
      ["Faults", status.faults.join(", ") || "none"],
      [
        "Banks",
        status.temperature_degc
          .map((degc, bank) => `${degc.toFixed(1)} °C, ${status.current_ma[bank] ?? 0} mA`)
          .join(" · "),
      ],
      ["Firmware", status.firmware],
    ];
    this.facts.replaceChildren(...rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
  }
}

/** Show a problem. A sentence that is shown already is not set again, so that screen readers do not repeat it. */
function showProblem(where: HTMLElement, problem: unknown): void {
  where.hidden = false;
  if (where.textContent !== sentenceOf(problem)) where.textContent = sentenceOf(problem);
}

function section(title: string, ...content: HTMLElement[]): HTMLElement {
  return element("section", {}, element("h3", {}, title), ...content);
}

function labelled(text: string, input: HTMLInputElement): HTMLElement {
  return element("label", { for: input.id }, text, input);
}

function numberInput(id: string, value: number, least: number, most: number): HTMLInputElement {
  return element("input", {
    id,
    type: "number",
    min: `${least}`,
    max: `${most}`,
    step: "1",
    value: `${value}`,
    required: "",
  });
}

function ofOthers(count: number): string {
  return count === 1 ? "1 job of others" : `${count} jobs of others`;
}
