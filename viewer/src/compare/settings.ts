/** Settings of shadows that the service supports, read from its OpenAPI document. */

import type { Service } from '../service';

export interface Setting {
  readonly name: string;
  readonly about: string;
  /** The values that it may have; empty where it is a number of a range. */
  readonly words: readonly string[];
  readonly example: string;
}

interface Schema {
  readonly enum?: readonly (string | number)[];
  readonly anyOf?: readonly Schema[];
  readonly type?: string;
  readonly examples?: readonly unknown[];
}

interface OpenApi {
  readonly paths: Readonly<Record<string, { readonly get?: { readonly parameters?: readonly Parameter[] } }>>;
}

interface Parameter {
  readonly name: string;
  readonly in: string;
  readonly description?: string;
  readonly schema: Schema;
}

/** Parameters of plans that are no settings of shadows, or have a choice of their own. */
const NONE = new Set(['view', 'zoom', 'tms', 'time', 'azimuth', 'altitude', 'policy', 'algorithm', 'style']);

let asked: Promise<readonly Setting[]> | null = null;

/** All settings; asked for once. Throws as `Service.json` does. */
export async function shadowSettings(service: Service, signal: AbortSignal): Promise<readonly Setting[]> {
  asked ??= service.json<OpenApi>(service.address('openapi.json'), signal, { early: true }).then(settingsIn);
  try {
    return await asked;
  } catch (error) {
    asked = null;
    throw error;
  }
}

export function settingsIn(document: OpenApi): Setting[] {
  const parameters = document.paths['/levels/{level}/plan']?.get?.parameters ?? [];
  return parameters.filter((each) => each.in === 'query' && !NONE.has(each.name)).map(({ name, description, schema }) => ({
    name, about: description ?? '', words: wordsIn(schema), example: String(schema.examples?.[0] ?? ''),
  }));
}

function wordsIn(schema: Schema): string[] {
  const own = schema.type === 'boolean' ? ['true', 'false'] : (schema.enum ?? []).map(String);
  return [...own, ...(schema.anyOf ?? []).flatMap(wordsIn)];
}
