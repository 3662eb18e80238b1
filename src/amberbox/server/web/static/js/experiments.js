// The catalogue of experiments: uploading one with its files.

import { ApiError, requestJson, toast, whileBusy } from "./api.js";
import { find } from "./dom.js";
import { t } from "./strings.js";

const SUFFIX = ".bpmn";

const form = find("#upload");
if (form) {
  form.hidden = false; // a browser without scripts cannot read files
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    whileBusy(form, event.submitter, upload);
  });
}

async function upload() {
  const chosen = [...form.elements.files.files];
  const [main, other] = chosen.filter((file) => file.name.endsWith(SUFFIX));
  if (!main) throw new ApiError(t("experiments.no_file"), "", 0);
  const name = main.name.slice(0, -SUFFIX.length);
  if (other) toast(t("experiments.several", { name }));
  const files = Object.fromEntries(await Promise.all(chosen.map(async (file) => [file.name, await asBase64(file)])));
  await requestJson("/api/v1/experiments", { method: "POST", body: { name, files } });
  location.reload();
}

/** Read a file as Base64. @param {File} file @returns {Promise<string>} */
function asBase64(file) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.addEventListener("load", () => resolve(reader.result.slice(reader.result.indexOf(",") + 1)));
    reader.addEventListener("error", () => reject(new ApiError(file.name, reader.error.message, 0)));
    reader.readAsDataURL(file);
  });
}
