/** Asks for a token. The server answers with a cookie that scripts cannot read; the page stores nothing. */

import { sentenceOf, signIn } from "./api";
import { element } from "./element";

export class SignIn {
  private readonly token = element("input", {
    id: "token",
    type: "password",
    autocomplete: "current-password",
    required: "",
    spellcheck: "false",
  });
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  readonly root = element(
    "form",
    { class: "sign-in" },
    element("h2", {}, "Sign in"),
    element("label", { for: "token" }, "Token, as dentine token create printed it"),
    this.token,
    element("button", {}, "Sign in"),
    this.refusal,
  );

  constructor(private readonly onSuccess: () => void) {
    this.refusal.hidden = true;
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.submit();
    });
  }

  private async submit(): Promise<void> {
    try {
      await signIn(this.token.value.trim());
      this.onSuccess();
    } catch (problem) {
      this.refusal.hidden = false;
      this.refusal.textContent = sentenceOf(problem);
      this.token.value = "";
      this.token.focus();
    }
  }
}
