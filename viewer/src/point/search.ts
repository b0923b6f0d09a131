/** The search for a place by its coordinates. */

import { html } from '../dom';
import type { PanelContext } from '../panels';
import { type PlacedLevel, inWords, isAbort, isPlaced } from '../service';
import { parseCoordinates } from './coordinates';

interface Location {
  readonly lon: number;
  readonly lat: number;
  readonly crs_name: string;
}

export interface Place {
  readonly lng: number;
  readonly lat: number;
}

/** Whether a place lies in a level's bounds. */
export function isWithin({ bounds: [west, south, east, north] }: Pick<PlacedLevel, 'bounds'>, { lng, lat }: Place): boolean {
  return west <= lng && lng <= east && south <= lat && lat <= north;
}

/** A form that finds a place of the level and hands it to `go`. Faults are told below it. Returns what ends its work, too. */
export function placeSearch({ service, level, announce }: PanelContext, go: (place: Place) => void): { element: HTMLElement; close: () => void } {
  let asking = new AbortController();
  const input = html('input', {
    type: 'text', id: 'place', placeholder: '47.1, 11.3', autocomplete: 'off', spellcheck: 'false', enterkeyhint: 'search', 'aria-describedby': 'place-note',
    oninput: () => say('', false),
  });
  const note = html('p', { class: 'note', id: 'place-note', role: 'status' });
  const say = (words: string, isFault: boolean) => {
    note.classList.toggle('fail', isFault);
    note.textContent = words;
    if (isFault) input.setAttribute('aria-invalid', 'true');
    else input.removeAttribute('aria-invalid');
  };

  const find = async () => {
    asking.abort();
    asking = new AbortController();
    const { signal } = asking;
    const here = level();
    if (!isPlaced(here)) return;
    const said = parseCoordinates(input.value);
    if (!said) {
      say('Latitude and longitude, as 47.1, 11.3 or 47°06\'N 11°18\'E, or two coordinates of the level’s grid.', true);
      return;
    }
    let [place, words]: [Place, string] = [{ lng: 0, lat: 0 }, ''];
    if (said.kind === 'degrees') place = { lng: said.lon, lat: said.lat };
    else {
      try {
        const found = await service.json<Location>(service.of(here.name, 'location', { x: said.x, y: said.y }), signal, { early: true });
        [place, words] = [{ lng: found.lon, lat: found.lat }, `Read as ${found.crs_name}.`];
      } catch (error) {
        if (!isAbort(error)) say(inWords(error), true);
        return;
      }
    }
    const turned = { lng: place.lat, lat: place.lng };
    if (said.kind === 'degrees' && !isWithin(here, place) && isWithin(here, turned) && !/[NSEWO]/i.test(input.value)) {
      [place, words] = [turned, 'Read as longitude, latitude.'];
    }
    if (!isWithin(here, place)) {
      say(`${place.lat.toFixed(4)}, ${place.lng.toFixed(4)} lies outside of ${here.title || here.name}.`, true);
      return;
    }
    say(words, false);
    announce(`Found ${place.lat.toFixed(5)}, ${place.lng.toFixed(5)}. ${words}`);
    go(place);
  };

  const element = html('form', {
    class: 'paste', role: 'search',
    onsubmit: (event) => {
      event.preventDefault();
      void find();
    },
  }, html('label', { for: 'place' }, 'Find coordinates'), html('div', {}, input, html('button', { type: 'submit' }, 'Find')), note);
  return { element, close: () => asking.abort() };
}
