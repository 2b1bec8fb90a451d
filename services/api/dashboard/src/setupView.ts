/**
 * The view of a setup link. It makes the administrator's token and signs the browser in; the token is shown this once,
 * beside the page.
 */

import { sentenceOf, setUp } from "./api";
import { element } from "./element";

export class SetupView {
  readonly root = element("article", { class: "setup" });
  private readonly make = element("button", { type: "button", class: "primary" }, "Make the administrator's token");
  private readonly refusal = element("p", { class: "failure", role: "alert" });

  constructor(
    private readonly secret: string,
    private readonly onSuccess: (token: string) => void,
  ) {
    this.refusal.hidden = true;
    this.make.addEventListener("click", () => void this.redeem());
    this.root.append(
      element("h2", {}, "Set up this server"),
      element(
        "p",
        {},
        "Nobody has a token for this server yet. Make the first one: it may do everything, other tokens " +
          "included, and this browser is signed in with it.",
      ),
      this.make,
      this.refusal,
    );
  }

  private async redeem(): Promise<void> {
    this.make.disabled = true;
    this.refusal.hidden = true;
    try {
      const { token } = await setUp(this.secret);
      history.replaceState(null, "", location.pathname); // the link is no longer valid and need not be shown again
      this.onSuccess(token);
    } catch (problem) {
      this.refusal.hidden = false;
      this.refusal.textContent = sentenceOf(problem);
      this.make.disabled = false;
    }
  }
}

/** Build a card with the token, which stays until its owner has stored the token. */
export function tokenCard(token: string, onKept: () => void): HTMLElement {
  const shown = element("code", { class: "token", tabindex: "0" }, token);
  const copied = element("span", { class: "done", role: "status" });
  const copy = element("button", { type: "button" }, "Copy");
  copy.addEventListener("click", () => void copyText(shown).then((sentence) => (copied.textContent = sentence)));
  const kept = element("button", { type: "button" }, "I have kept it");
  kept.addEventListener("click", onKept);
  return element(
    "section",
    { class: "setup" },
    element("h2", {}, "Your administrator's token"),
    element(
      "p",
      {},
      "Keep it where you keep passwords: it is not shown again. This browser is signed in already; the command " +
        "line reads it from the variable DENTINE__CLIENT__TOKEN.",
    ),
    shown,
    element("p", { class: "fields" }, copy, kept, copied),
  );
}

/** Copy the text where the browser allows pages to, else select it; resolves to a sentence for the person. */
async function copyText(shown: HTMLElement): Promise<string> {
  try {
    await navigator.clipboard.writeText(shown.textContent ?? "");
    return "Copied.";
  } catch {
    getSelection()?.selectAllChildren(shown);
    return "Selected; copy it with the keyboard.";
  }
}
