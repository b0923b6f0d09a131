/** Editor of a new view: eye and target on the map, a preview, and the lines for the level file. */

import { type GeoJSONSource, type Map as MapLibre, Marker } from 'maplibre-gl';

import { html } from '../dom';
import type { PanelContext } from '../panels';
import { takeNextClick } from '../picking';
import { copyButton } from '../saved';
import { distanceText, wind } from '../point/words';
import { isPlaced } from '../service';
import type { State } from '../state';
import { type Camera, FOV_DEG, STANDING_M, VIEW_SIZE, bearing_deg, parsePosition, positionText, reach_m, viewYaml, wedge } from './camera';
import { Picture, snapshotQuery } from './snapshot';
import { openPicture } from './whole_picture';

const EYE = 'views-eye';
const TARGET = 'views-target';
const FOV = 'views-fov';
const SIGHT = 'views-sight';
const EDGE = 'views-sight-edge';
const CALM_MS = 400;
const PREVIEW_SIZE = '400x320';

export function cameraIn(own: State['own']): Camera | null {
  const [eye, target] = [parsePosition(own[EYE]), parsePosition(own[TARGET])];
  const fov = Number(own[FOV] ?? FOV_DEG);
  return eye && target ? { eye, target, fov: fov > 0 && fov < 180 ? fov : FOV_DEG } : null;
}

export function mountMaker(container: HTMLElement, context: PanelContext): () => void {
  const { store, map, service, announce } = context;
  let stopPicking = () => {};

  const setPlace = (name: typeof EYE | typeof TARGET, { lng, lat }: { lng: number; lat: number }) => {
    const camera = cameraIn(store.state.own) ?? cameraBefore(map);
    const height = (name === EYE ? camera.eye : camera.target)[2];
    const changed = { eye: camera.eye, target: camera.target, [name === EYE ? 'eye' : 'target']: [lng, lat, height] as const };
    store.setOwn({ [EYE]: positionText(changed.eye), [TARGET]: positionText(changed.target) });
  };
  const setHeight = (name: typeof EYE | typeof TARGET, text: string) => {
    const camera = cameraIn(store.state.own);
    const height = Number(text);
    if (!camera || text === '' || !Number.isFinite(height)) return;
    const [lon, lat] = name === EYE ? camera.eye : camera.target;
    store.setOwn({ [name]: positionText([lon, lat, height]) });
  };
  const pick = (name: typeof EYE | typeof TARGET, what: string) => {
    stopPicking();
    announce(`Click on the map: ${what}`);
    said.textContent = `Click on the map: ${what}. Or move the map, and put it at the middle.`;
    stopPicking = takeNextClick(map, (place) => {
      said.textContent = '';
      setPlace(name, place);
    });
  };

  const start = html('button', {
    type: 'button', class: 'main',
    onclick: () => {
      const camera = cameraBefore(map);
      store.setOwn({ [EYE]: positionText(camera.eye), [TARGET]: positionText(camera.target) });
    },
  }, 'Make a view');
  const eyeHeight = numberField('views-eye-height', 'Eye, metres above the ground', (text) => setHeight(EYE, text));
  const targetHeight = numberField('views-target-height', 'Target, metres above the ground', (text) => setHeight(TARGET, text));
  const fov = html('input', {
    type: 'range', id: 'views-fov', min: 5, max: 120, step: 1,
    oninput: () => store.setOwn({ [FOV]: fov.value === String(FOV_DEG) ? null : fov.value }),
  });
  const fovSaid = html('output', { for: 'views-fov' });
  const name = html('input', { type: 'text', id: 'views-name', value: 'my_view', maxlength: 60, oninput: () => show(store.state) });
  const yaml = html('pre', { class: 'lines', tabindex: 0, 'aria-label': 'Lines for the level’s file' });
  const said = html('p', { class: 'note', role: 'status' });
  const facts = html('p', { class: 'facts' });
  const picture = new Picture(service, 'What is seen from there');
  const whole = html('button', {
    type: 'button',
    onclick: () => {
      const camera = cameraIn(store.state.own);
      if (!camera) return;
      const { state } = store;
      const level = context.level();
      openPicture(service, name.value || 'My view', addressOf(camera, state, 'png', null), `${state.level}-${name.value || 'view'}`, isPlaced(level) ? {
        level, state, size: VIEW_SIZE, film: { camera }, address: (at, suffix, size) => addressOf(camera, at, suffix, size),
      } : null);
    },
  }, 'Whole picture');
  const form = html('div', { class: 'maker' },
    html('div', { class: 'pick' },
      html('button', { type: 'button', onclick: () => pick(EYE, 'stand here') }, 'Stand here …'),
      html('button', { type: 'button', class: 'plain', onclick: () => setPlace(EYE, map.getCenter()) }, html('span', { class: 'unseen' }, 'Stand '), 'at the middle'),
      html('button', { type: 'button', onclick: () => pick(TARGET, 'look there') }, 'Look there …'),
      html('button', { type: 'button', class: 'plain', onclick: () => setPlace(TARGET, map.getCenter()) }, html('span', { class: 'unseen' }, 'Look '), 'at the middle')),
    said,
    eyeHeight.label, targetHeight.label,
    html('label', { class: 'row', for: 'views-fov' }, html('span', {}, 'Field of view ', fovSaid), fov),
    facts,
    html('div', { class: 'preview' }, picture.element),
    html('div', { class: 'buttons' }, whole, html('button', {
      type: 'button', class: 'plain',
      onclick: () => {
        store.setOwn({ [EYE]: null, [TARGET]: null, [FOV]: null });
        start.focus();
      },
    }, 'Discard')),
    html('label', { class: 'row', for: 'views-name' }, 'Name in the level’s file', name),
    html('div', { class: 'copied' }, yaml, copyButton(() => yaml.textContent ?? '', 'the lines for the level’s file')),
  );
  container.append(html('h2', {}, 'A view of your own'),
    html('p', { class: 'note' }, 'Stand here, look there: see it, and take the lines into the level’s file.'), start, form);

  const addressOf = (camera: Camera, state: State, suffix: 'png' | 'webp', size: string | null) => service.of(state.level, `snapshot.${suffix}`, {
    eye: positionText(camera.eye), target: positionText(camera.target), fov: camera.fov, size, ...snapshotQuery(state),
  });

  const sight = new Sight(map, (which, place) => setPlace(which === 'eye' ? EYE : TARGET, place));
  let timer: number | undefined;
  const show = (state: State) => {
    const camera = cameraIn(state.own);
    start.hidden = camera !== null;
    form.hidden = camera === null;
    sight.show(camera);
    clearTimeout(timer);
    if (!camera) return;
    if (document.activeElement !== eyeHeight.input) eyeHeight.input.value = String(camera.eye[2]);
    if (document.activeElement !== targetHeight.input) targetHeight.input.value = String(camera.target[2]);
    fov.value = String(camera.fov);
    fovSaid.value = `${camera.fov}°`;
    facts.textContent = `Looking ${wind(bearing_deg(camera))}, ${distanceText(reach_m(camera))} away.`;
    yaml.textContent = viewYaml(camera, name.value);
    timer = window.setTimeout(() => void picture.show(addressOf(camera, state, 'webp', PREVIEW_SIZE)), CALM_MS);
  };
  const end = store.watch((state) => [cameraIn(state.own), state.level, snapshotQuery(state)] as const, (_, state) => show(state));
  return () => {
    end();
    clearTimeout(timer);
    stopPicking();
    sight.close();
    picture.close();
  };
}

function numberField(id: string, label: string, changed: (text: string) => void) {
  const input = html('input', { type: 'number', id, min: -1000, max: 100_000, step: 'any', inputmode: 'decimal', oninput: () => changed(input.value) });
  return { input, label: html('label', { class: 'row', for: id }, label, input) };
}

/** A view from the lower part of the map up to its middle. */
function cameraBefore(map: MapLibre): Camera {
  const { clientWidth, clientHeight } = map.getContainer();
  const eye = map.unproject([clientWidth / 2, clientHeight * 0.7]);
  const target = map.getCenter();
  return { eye: [eye.lng, eye.lat, STANDING_M], target: [target.lng, target.lat, 0], fov: FOV_DEG };
}

/** Eye, target and what is seen between, on the map; both can be dragged. */
class Sight {
  readonly #markers: Record<'eye' | 'target', Marker>;
  #there = false;

  constructor(private readonly map: MapLibre, moved: (which: 'eye' | 'target', place: { lng: number; lat: number }) => void) {
    const marker = (which: 'eye' | 'target') => {
      const made = new Marker({ element: html('div', { class: `sight-mark ${which}`, 'aria-hidden': 'true' }), draggable: true });
      made.on('dragend', () => moved(which, made.getLngLat()));
      return made;
    };
    this.#markers = { eye: marker('eye'), target: marker('target') };
    map.on('styledata', this.#rise);
  }

  /** Ends it. */
  close(): void {
    this.map.off('styledata', this.#rise);
    this.remove();
  }

  /** The level's layer may come later, and would lie on it. */
  readonly #rise = () => {
    const top = this.map.getStyle().layers.slice(-2).map(({ id }) => id);
    if (!this.map.getLayer(SIGHT) || (top[0] === SIGHT && top[1] === EDGE)) return;
    this.map.moveLayer(SIGHT);
    this.map.moveLayer(EDGE);
  };

  show(camera: Camera | null): void {
    if (!camera) {
      this.remove();
      return;
    }
    this.#markers.eye.setLngLat([camera.eye[0], camera.eye[1]]);
    this.#markers.target.setLngLat([camera.target[0], camera.target[1]]);
    const data = { type: 'Feature', properties: {}, geometry: { type: 'Polygon', coordinates: [wedge(camera)] } } as const;
    const source = this.map.getSource<GeoJSONSource>(SIGHT);
    if (source) source.setData(data as never);
    else {
      this.map.addSource(SIGHT, { type: 'geojson', data: data as never });
      this.map.addLayer({ id: SIGHT, type: 'fill', source: SIGHT, paint: { 'fill-color': '#ffffff', 'fill-opacity': 0.28 } });
      this.map.addLayer({ id: EDGE, type: 'line', source: SIGHT, paint: { 'line-color': '#ffffff', 'line-width': 2 } });
    }
    if (!this.#there) for (const marker of Object.values(this.#markers)) marker.addTo(this.map);
    this.#there = true;
  }

  remove(): void {
    if (this.#there) for (const marker of Object.values(this.#markers)) marker.remove();
    this.#there = false;
    for (const layer of [EDGE, SIGHT]) if (this.map.getLayer(layer)) this.map.removeLayer(layer);
    if (this.map.getSource(SIGHT)) this.map.removeSource(SIGHT);
  }
}
