/** How a rig is connected: which settings it needs and where, and whether the dome of the server answers. */

import {
  FIRST_PATIENCE_MS,
  getDome,
  listCalibrations,
  type NamedCalibration,
  sentenceOf,
  Unauthenticated,
} from "./api";
import { element } from "./element";
import { when } from "./format";
import { SUBMIT } from "./newJobView";

export class RigView {
  readonly root = element("article", { class: "rig" });
  private readonly check = element("button", { type: "button" }, "Check the dome");
  private readonly found = element("p", { role: "status" });
  private readonly calibrations = element("div", {
    class: "scroll",
    role: "region",
    "aria-label": "Calibrations",
    tabindex: "0",
  });

  constructor() {
    this.check.addEventListener("click", () => void this.look());
    const code = (text: string) => element("code", {}, text);
    this.root.append(
      element("h2", {}, "Connect a rig"),
      section(
        "1. The dome's address",
        element(
          "p",
          {},
          "Set ",
          code("DENTINE__SERVER__DOME__ADDRESS=HOST:PORT"),
          " for the server, the address of the dome's Modbus controller, and start it again. Further domes " +
            "that jobs may light are listed in ",
          code("DENTINE__SERVER__DOME__JOB_ADDRESSES"),
          ".",
        ),
        element(
          "p",
          {},
          "Where workers run on their own, the one that reaches the dome is started with ",
          code("--resources DOME=1"),
          "; let there be one of it alone.",
        ),
        element("p", { class: "fields" }, this.check, this.found),
      ),
      section(
        "2. The calibration",
        element(
          "p",
          {},
          "A folder with ",
          code("capture.json"),
          " (cameras, lights and channels, lengths in mm) and the scan's meshes as ",
          code("teeth/<FDI>/outer.ply"),
          ". Upload it like a capture, or put it where server and workers see it and give its path.",
        ),
        element("p", {}, element("a", { href: "#/new" }, "Upload the folder")),
        element(
          "p",
          {},
          "A job of kind ",
          code("calibration"),
          " measures the rig from a raw folder; ",
          element("em", {}, "Keep the calibration"),
          " on its page puts the result under a name. A calibration of ",
          code("dentine calibrate"),
          " is put there by ",
          code("PUT /v1/calibrations/NAME"),
          ". Jobs name it as ",
          code("calibrations/NAME"),
          ".",
        ),
        this.calibrations,
      ),
      section(
        "3. The limits of light",
        element(
          "p",
          {},
          "Level, exposure and dose are limited by the server, whatever a job asks for. The defaults are " +
            "placeholders: set them from a photobiological assessment of your lights, ",
          code("DENTINE__SERVER__DOME__…"),
          ".",
        ),
      ),
      section(
        "4. Try it, then capture",
        element(
          "p",
          {},
          "The dome's own page lights single lights for alignment, has ALL OFF, and runs the preflight. Then " +
            "submit a job that captures.",
        ),
        element(
          "p",
          { class: "fields" },
          element("a", { class: "button", href: "#/dome" }, "Open the dome's page"),
          element("a", { class: "button primary", href: `${SUBMIT}/rig` }, "Submit a job with a rig"),
        ),
      ),
    );
  }

  async start(): Promise<void> {
    const [, listed] = await Promise.all([this.look(), listCalibrations()]);
    this.calibrations.replaceChildren(
      ...(listed.length ? [tableOf(listed)] : [element("p", { class: "soft" }, "There is none yet.")]),
    );
  }

  stop(): void {}

  private async look(): Promise<void> {
    this.check.disabled = true;
    this.found.className = "";
    this.found.textContent = "The dome is being asked.";
    try {
      const { address, status } = await getDome(FIRST_PATIENCE_MS);
      const faults = [
        ...status.faults,
        ...(status.interlock_closed ? [] : ["its interlock is open"]),
        ...(status.emergency_stop ? ["its emergency stop is pressed"] : []),
      ];
      this.found.className = faults.length ? "bad" : "done";
      const said = `${status.light_count} lights, firmware ${status.firmware}`;
      const trouble = faults.length ? `; ${faults.join(", ")}` : "";
      this.found.textContent = `The dome at ${address} answers: ${said}${trouble}.`;
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.found.className = "bad";
      this.found.textContent = sentenceOf(problem);
    } finally {
      this.check.disabled = false;
    }
  }
}

function section(title: string, ...content: HTMLElement[]): HTMLElement {
  return element("section", {}, element("h3", {}, title), ...content);
}

/** Build the table of calibrations: the state of each, and whether jobs may use it. */
function tableOf(listed: NamedCalibration[]): HTMLElement {
  const head = ["Name", "State", "Made", ""].map((text) => element("th", { scope: "col" }, text));
  const rows = listed.map((one) => {
    const bad = one.state === "beyond its limits" || one.state === "old";
    return element(
      "tr",
      {},
      element("td", {}, one.name),
      element("td", { class: bad ? "bad" : one.state === "good" ? "done" : "soft" }, one.state),
      element("td", {}, when(one.made ? Date.parse(one.made) / 1000 : one.created_s)),
      element("td", {}, toldOf(one)),
    );
  });
  return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows));
}

function toldOf(one: NamedCalibration): string {
  if (one.broken?.length) return `${one.broken.join("; ")}. Jobs refuse it unless they accept_calibration.`;
  if (one.state === "old") return `It was made to hold for ${one.valid_days} days; calibrate again.`;
  return one.state === "good" ? "" : "It states neither limits nor how long it holds.";
}
