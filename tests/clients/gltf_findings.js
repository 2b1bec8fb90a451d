// Program for Node: print as JSON what Khronos' validator finds in a glTF file, the second word.
'use strict';
const fs = require('fs'), path = require('path'), validator = require('gltf-validator');
const file = process.argv[2];
const read = async uri => new Uint8Array(fs.readFileSync(path.join(path.dirname(file), decodeURI(uri))));
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {externalResourceFunction: read})
  .then(report => console.log(JSON.stringify(report.issues.messages)));
