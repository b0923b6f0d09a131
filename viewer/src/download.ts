/** Download of the visible extent, which the service draws as a picture or as a georeferenced raster. */

import type { LngLatBounds } from 'maplibre-gl';

import { html } from './dom';
import type { PanelContext } from './panels';
import { pictureQuery } from './query';
import { saveFile } from './saved';
import { type Query, inWords, isAbort } from './service';

/** Of a map's sides, pixels, as the service has it. */
const LONGEST_PX = 4096;
/** Pixels of a map in all: what services allow unless they are told otherwise. */
const MOST_PX = 4_000_000;
const EARTH_RADIUS_M = 6_378_137;

/** What is asked of a map of an extent in Web Mercator, of as many pixels as are seen, or fewer where that is too many. */
export function extentQuery(bounds: Pick<LngLatBounds, 'getWest' | 'getSouth' | 'getEast' | 'getNorth'>, pixelsAcross: number): Query {
  const x = (lon: number) => (EARTH_RADIUS_M * lon * Math.PI) / 180;
  const y = (lat: number) => EARTH_RADIUS_M * Math.asinh(Math.tan((lat * Math.PI) / 180));
  const [west, south, east, north] = [x(bounds.getWest()), y(bounds.getSouth()), x(bounds.getEast()), y(bounds.getNorth())];
  const aspect = (east - west) / (north - south);
  const width = Math.min(pixelsAcross, LONGEST_PX, LONGEST_PX * aspect, Math.sqrt(MOST_PX * aspect));
  return {
    bbox: [west, south, east, north].map((value) => value.toFixed(2)).join(','),
    crs: 'EPSG:3857',
    width: Math.max(Math.floor(width), 1),
    height: Math.max(Math.floor(width / aspect), 1),
  };
}

/** Fills a part of a panel. Returns what ends its work. */
export function mountDownload(container: HTMLElement, { store, map, service, level }: PanelContext): () => void {
  const said = html('p', { class: 'note', role: 'status' });
  let loading = new AbortController();
  const save = async (suffix: 'png' | 'tif') => {
    loading.abort();
    loading = new AbortController();
    const across = Math.round(map.getContainer().clientWidth * window.devicePixelRatio);
    const address = service.of(level().name, `map.${suffix}`, { ...extentQuery(map.getBounds(), across), ...pictureQuery(store.state) });
    said.classList.remove('fail');
    said.textContent = 'The service is drawing it …';
    try {
      await saveFile(service, address, `${level().name}-${store.state.layer}.${suffix}`, loading.signal);
      said.textContent = 'Saved.';
    } catch (error) {
      if (isAbort(error)) return;
      said.classList.add('fail');
      said.textContent = `Not saved: ${inWords(error)}`;
    }
  };
  container.append(
    html('h2', {}, 'Download what is seen'),
    html('p', { class: 'note' }, 'North is up, and the ground lies flat, also where the map is turned or tilted.'),
    html('div', { class: 'buttons' },
      html('button', { type: 'button', onclick: () => void save('png') }, 'PNG picture'),
      html('button', { type: 'button', onclick: () => void save('tif') }, 'GeoTIFF')),
    said,
  );
  return () => loading.abort();
}
