/** The panel of the plan: what the service draws and why, with the algorithms and intermediate layers folded. */

import { html } from '../dom';
import { TILE_SIZE } from '../map';
import type { Panel, PanelContext } from '../panels';
import { sunQuery } from '../query';
import { inWords, isAbort, isPlaced } from '../service';
import { settingsQuery, withSetting } from '../shadow_settings';
import { shotsOf } from '../stage';
import { snapshotQuery } from '../views/snapshot';
import { openPicture } from '../views/whole_picture';
import { viewTitle } from '../views/titles';
import { type Named, type Plan, choices, effectsInWords, expectation, isCalibrating, isUncalibrated, rejectedInWords, settingsInWords } from './words';
import './plan.css';

const CALM_MS = 300;
const CALIBRATING_MS = 10_000;

function mount(container: HTMLElement, context: PanelContext): () => void {
  const { store, map, service, level } = context;
  const drawn = html('dl');
  const leftOut = html('dl');
  const taken = html('dl');
  const chosen = html('dl');
  const rejected = html('dl');
  const cost = html('p', { class: 'note' });
  const failed = html('p', { class: 'fail', role: 'status', hidden: true });
  const algorithm = html('select', { id: 'plan-algorithm', onchange: () => store.setOwn(withSetting('algorithm', algorithm.value || null)) });
  const body = html('div', { class: 'plan', 'aria-busy': 'true' },
    html('h2', {}, 'What is drawn, and why'), drawn,
    html('details', {}, html('summary', {}, 'What is left out, and why'), leftOut),
    html('details', { class: 'algorithms' }, html('summary', {}, 'Algorithms'), taken, cost,
      html('label', { class: 'row', for: 'plan-algorithm' }, 'Draw shadows by', algorithm),
      html('details', {}, html('summary', {}, 'Settings that were chosen'), chosen),
      html('details', {}, html('summary', {}, 'Rejected algorithms'), rejected)));
  const layers = html('details', { class: 'layers-between' }, html('summary', {}, 'Layers in between'));
  container.append(failed, body, layers);

  let planning = new AbortController();
  let timer: number | undefined;
  let planned = '';
  const plan = async () => {
    const { state } = store;
    // The ways to the algorithms stay the same whatever is chosen; hours of sun have no plan of one sun.
    const seen = isPlaced(level()) ? { zoom: tileZoom(context) } : { view: state.shot ?? shotsOf(level())[0] };
    const url = service.of(level().name, 'plan', { ...seen, ...sunQuery(state), ...settingsQuery(state) });
    if (url === planned) return;
    planning.abort();
    planning = new AbortController();
    const { signal } = planning;
    body.setAttribute('aria-busy', 'true');
    try {
      const found = await service.json<Plan>(url, signal);
      planned = url;
      fill(drawn, effectsInWords(found.effects));
      fill(leftOut, effectsInWords(found.left_out));
      fill(taken, choices(found));
      fill(chosen, settingsInWords(found));
      fill(rejected, rejectedInWords(found.rejected));
      if (isUncalibrated(found)) await service.readiness.check();
      if (signal.aborted) return;
      const { calibration } = service.readiness.current;
      cost.textContent = expectation(found, calibration);
      // The plan is another one as soon as the service knows its device.
      if (isUncalibrated(found) && isCalibrating(calibration)) {
        planned = '';
        timer = window.setTimeout(() => void plan(), CALIBRATING_MS);
      }
      failed.hidden = true;
      body.hidden = false;
    } catch (error) {
      if (isAbort(error)) return;
      planned = '';
      body.hidden = true;
      failed.hidden = false;
      failed.textContent = `No plan: ${inWords(error)}`;
    }
    body.setAttribute('aria-busy', 'false');
  };
  const planSoon = () => {
    clearTimeout(timer);
    timer = window.setTimeout(() => void plan(), CALM_MS);
  };
  const end = store.watch((state) => [state.level, state.shot, sunQuery(state), settingsQuery(state)] as const, (_, state) => {
    if (document.activeElement !== algorithm) {
      const asked = state.own['plan-algorithm'] ?? '';
      algorithm.replaceChildren(html('option', { value: '' }, 'what the service finds best'),
        ...level().algorithms.map((name) => html('option', { value: name, selected: name === asked }, name.replaceAll('_', ' '))));
    }
    planSoon();
  });
  const endLayers = store.watch(({ level: name }) => name, () => {
    layers.replaceChildren(html('summary', {}, 'Layers in between'), ...layersBetween(context));
  });
  map.on('moveend', planSoon);
  return () => {
    end();
    endLayers();
    map.off('moveend', planSoon);
    clearTimeout(timer);
    planning.abort();
  };
}

/** What passes leave behind on the way to a picture of a view, each to be looked at. */
function layersBetween({ store, service, level }: PanelContext): Node[] {
  const { name: levelName, views, layers, layers_between: between, title } = level();
  const named = views.includes('map') ? views : ['map', ...views];
  const view = html('select', { id: 'between-view' }, ...named.map((name) => html('option', { value: name }, viewTitle(name))));
  const layer = html('select', { id: 'between-layer' },
    ...[...between, ...layers.filter((name) => name !== 'color')].map((name) => html('option', { value: name }, name.replaceAll('-', ' '))));
  const open = () => openPicture(
    service, `${layer.value.replaceAll('-', ' ')} · ${viewTitle(view.value)} · ${title}`,
    service.of(levelName, 'snapshot.png', { view: view.value, layer: layer.value, ...snapshotQuery(store.state), style: null }),
    `${levelName}-${view.value}-${layer.value}`, null,
  );
  return [
    html('p', { class: 'note' }, 'What algorithms work with on the way to the picture of a view.'),
    html('label', { class: 'row', for: 'between-view' }, 'View', view),
    html('label', { class: 'row', for: 'between-layer' }, 'Layer', layer),
    html('button', { type: 'button', onclick: open }, 'Look at it'),
  ];
}

/** The zoom of the tiles on screen, within those that the level has. */
function tileZoom({ map, level }: PanelContext): number {
  const { minzoom, maxzoom } = level();
  return Math.min(Math.max(Math.round(map.getZoom() + Math.log2(512 / TILE_SIZE)), minzoom ?? 0), maxzoom ?? 22);
}

function fill(list: HTMLElement, items: readonly Named[]): void {
  list.replaceChildren(...items.flatMap(({ name, reason }) => [html('dt', {}, name), html('dd', {}, reason)]));
}

export const planPanel: Panel = { id: 'plan', title: 'Why', needsNoMap: true, mount };
