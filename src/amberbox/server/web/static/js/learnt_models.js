// Learnt detectors: the form that lets the server learn one, and the list with its progress.

import { ApiError, requestJson, whileBusy } from "./api.js";
import { find, findAll } from "./dom.js";
import { subscribe } from "./feed.js";
import { throttledFragment } from "./fragments.js";
import { t } from "./strings.js";
import { fieldToStamp } from "./time.js";

const form = find("#ask");
const refreshJobs = throttledFragment(() => find("#jobs"), () => "/pieces/models");
const checkedValues = (name) => findAll(`input[name="${name}"]:checked`, form).map((box) => box.value);

/** Return the request for the API; throws ApiError. */
function requestBody() {
  const { missions, from, to, rate, name } = form.elements;
  const robots = checkedValues("robot");
  const detectors = checkedValues("detector");
  if (!robots.length) throw new ApiError(t("learnt_models.no_robot"), t("learnt_models.no_robot_hint"), 0);
  if (!detectors.length) throw new ApiError(t("learnt_models.no_detector"), t("learnt_models.no_detector_hint"), 0);
  return {
    robots, detectors, name: name.value, missions: missions.value.split(/[\s,]+/).filter(Boolean),
    team: checkedValues("team").length > 0, from: fieldToStamp(from.value), to: fieldToStamp(to.value), false_alarms_per_hour: Number(rate.value),
  };
}

async function learnModel() {
  await requestJson("/api/v1/models", { method: "POST", body: requestBody() });
  form.closest("details").open = false;
  refreshJobs();
  find("#jobs").scrollIntoView({ block: "nearest" });
}

function start() {
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    whileBusy(form, event.submitter ?? find("button.primary", form), learnModel);
  });
  find('[name="team"]', form)?.addEventListener("change", ({ target }) => {
    if (target.checked) find('[name="detector"][value="state_flow"]', form).checked = true; // it knows teams
  });
}

if (form) start();
find("#models").addEventListener("done", refreshJobs);
const feed = subscribe({ robots: [], kinds: ["job"] });
feed.on("job", refreshJobs);
feed.on("snapshot", refreshJobs);
